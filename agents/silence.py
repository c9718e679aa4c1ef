"""How long something has been silent, as far as this process was awake to hear it."""

from __future__ import annotations

PAUSE_S = 0.5
"""Between two looks no more than this counts, unless said otherwise: what came while the process was stopped, or its
machine suspended, lies in a queue and is about to be heard."""


class WitnessedSilence:
    """``silent_s``: seconds since the newest sign of life, without the time in which nobody listened: between two looks
    at most ``pause_s`` counts."""

    def __init__(self, pause_s: float = PAUSE_S) -> None:
        self._pause_s = pause_s
        self.silent_s = 0.0
        self._newest_s: float | None = None
        self._looked_s: float | None = None

    def look(self, newest_s: float, now_s: float) -> float:
        """``newest_s``: when the newest sign came; what ``silent_s`` has become."""
        if newest_s != self._newest_s or self._looked_s is None:
            self._newest_s = newest_s
            listened_from_s = newest_s if self._looked_s is None else max(newest_s, self._looked_s)
            self.silent_s = min(now_s - listened_from_s, self._pause_s)
        else:
            self.silent_s += min(now_s - self._looked_s, self._pause_s)
        self._looked_s = now_s
        return self.silent_s
