"""How long something has been silent, as far as this process was awake to hear it."""

from __future__ import annotations

PAUSE_S = 0.5
"""Between two looks no more than this counts: what came while the process was stopped, or its machine suspended, lies
in a queue and is about to be heard."""


class WitnessedSilence:
    """``silent_s``: seconds since the newest sign of life, without the time in which nobody listened."""

    def __init__(self) -> None:
        self.silent_s = 0.0
        self._newest_s: float | None = None
        self._looked_s: float | None = None

    def look(self, newest_s: float, now_s: float) -> float:
        """``newest_s``: when the newest sign came; what ``silent_s`` has become."""
        if newest_s != self._newest_s or self._looked_s is None:
            self._newest_s = newest_s
            listened_from_s = newest_s if self._looked_s is None else max(newest_s, self._looked_s)
            self.silent_s = min(now_s - listened_from_s, PAUSE_S)
        else:
            self.silent_s += min(now_s - self._looked_s, PAUSE_S)
        self._looked_s = now_s
        return self.silent_s
