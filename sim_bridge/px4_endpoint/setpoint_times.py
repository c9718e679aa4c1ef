"""When setpoints came in at one vehicle: the gaps between them, and how old the newest was while it was flown."""

from __future__ import annotations

from array import array

import numpy as np

PERCENTILES = (50, 99, 100)
GAP_MAX_S = 5.0
"""A longer silence is a pause between two flights or agents, not a gap of a stream."""


class SetpointTimes:
    def __init__(self) -> None:
        self.count = 0
        self._newest_s: float | None = None
        self._gaps_s = array("d")
        self._ages_s = array("d")

    def arrived(self, now_s: float) -> None:
        self.count += 1
        if self._newest_s is not None and now_s - self._newest_s < GAP_MAX_S:
            self._gaps_s.append(now_s - self._newest_s)
        self._newest_s = now_s

    def flown(self, now_s: float) -> None:
        """Call at regular times while the vehicle obeys setpoints."""
        if self._newest_s is not None:
            self._ages_s.append(now_s - self._newest_s)

    def summary(self) -> dict[str, object]:
        return {"setpoints": self.count, "gap_s": _spread(self._gaps_s), "age_s": _spread(self._ages_s)}


def _spread(values: array[float]) -> dict[str, float] | None:
    """None without values."""
    if not values:
        return None
    p50, p99, highest = np.percentile(np.array(values), PERCENTILES).tolist()
    return {"p50": p50, "p99": p99, "max": highest}
