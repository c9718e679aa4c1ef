"""Where ticks come from. Time is injected: nothing in the mission reads a wall clock by itself."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Protocol

from protocol import topics
from protocol.bus import Bus
from protocol.messages import Tick

SIMULATOR_PATIENCE_S = 20.0
"""A simulator that was neither heard nor seen in so long a wait is given up; a router's restart takes a few seconds."""


class Clock(Protocol):
    async def next_tick(self, timeout_s: float) -> Tick | None:
        """The next tick in order; None when none came in ``timeout_s`` of wall time."""
        ...

    @property
    def backlog(self) -> int:
        """Ticks that came since the one returned last: this process is late by so many."""
        ...

    @property
    def is_gone(self) -> bool:
        """Whether no tick is to be expected any more."""
        ...

    def now_s(self) -> float:
        """Monotonic seconds by which silence is judged; callable from any thread."""
        ...


class SimulatorClock:
    """Ticks of the internal simulator.

    In lockstep, time is the mission's own and stands still while the simulator waits; in real time it is the
    machine's, so that a simulator that stops is noticed like any vehicle that does.
    """

    def __init__(self, bus: Bus, *, lockstep: bool, now_s: Callable[[], float] = time.monotonic) -> None:
        self._bus, self._lockstep, self._now_s = bus, lockstep, now_s
        self._ticks: deque[Tick] = deque()
        self._newest = -1
        self._time_s = 0.0
        self._waited_s: float | None = None
        bus.on(topics.TICK, self._hear)

    def _hear(self, tick: Tick) -> None:
        self._waited_s = 0.0
        if tick.tick <= self._newest:  # said again for those who just came, or late
            return
        self._newest = tick.tick
        self._ticks.append(tick)
        self._time_s = tick.time_s

    async def next_tick(self, timeout_s: float) -> Tick | None:
        if await self._bus.until(lambda: bool(self._ticks), timeout_s):
            return self._ticks.popleft()
        if self._waited_s is not None:  # time spent waiting: while this process is stopped, it hears nobody
            self._waited_s += timeout_s
        return None

    @property
    def backlog(self) -> int:
        return len(self._ticks)

    @property
    def is_gone(self) -> bool:
        if self._waited_s is None or "sim" in self._bus.alive:
            return False
        return self._waited_s > SIMULATOR_PATIENCE_S

    def now_s(self) -> float:
        return self._time_s if self._lockstep else self._now_s()
