"""How long something takes: in CPU seconds, because machines are shared."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable


def cpu_s(action: Callable[[], object], repeats: int) -> list[float]:
    """CPU seconds of each of ``repeats`` calls."""
    times = []
    for _ in range(repeats):
        began = time.process_time()
        action()
        times.append(time.process_time() - began)
    return times


def median_s(action: Callable[[], object], repeats: int) -> float:
    """Median CPU seconds of one call."""
    return statistics.median(cpu_s(action, repeats))
