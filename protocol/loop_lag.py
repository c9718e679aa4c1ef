"""How late an event loop gets to its work: the first thing to look at when a process seems slow.

A timer is due every `PERIOD_S`; a loop that computes, or that a full link holds up, comes to it late.
"""

from __future__ import annotations

import asyncio
import math
from collections import deque

PERIOD_S = 0.02
WINDOW_S = 10.0
SAMPLES = int(WINDOW_S / PERIOD_S)


class LoopLag:
    """Lateness of the loop over the last `WINDOW_S`, in seconds; 0 before anything is known."""

    def __init__(self) -> None:
        self._lags_s: deque[float] = deque(maxlen=SAMPLES)

    async def watch(self) -> None:
        """Until it is cancelled."""
        loop = asyncio.get_running_loop()
        while True:
            due = loop.time() + PERIOD_S
            await asyncio.sleep(PERIOD_S)
            self.record(max(0.0, loop.time() - due))

    def record(self, late_s: float) -> None:
        """One timer was late by ``late_s``; so would those have been, each by less, that were due in the meantime.

        Without them a loop that stands still for a second would count as one late wake-up among hundreds.
        """
        missed = min(int(late_s / PERIOD_S), SAMPLES - 1)
        self._lags_s.extend(late_s - number * PERIOD_S for number in range(missed + 1))

    @property
    def p99_s(self) -> float:
        """The smallest lateness that 99 of 100 did not exceed."""
        ordered = sorted(self._lags_s)
        return ordered[math.ceil(0.99 * len(ordered)) - 1] if ordered else 0.0

    @property
    def max_s(self) -> float:
        return max(self._lags_s, default=0.0)
