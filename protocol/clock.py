"""Where ticks come from. Time is injected: nothing in the mission reads a wall clock by itself."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Protocol

from protocol import topics
from protocol.bus import Bus
from protocol.messages import Tick
from protocol.mission import Mission

SIMULATOR_PATIENCE_S = 20.0
"""A simulator that was neither heard nor seen in so long a wait is given up; a router's restart takes a few seconds."""
LATE_TICKS = 0.5
"""How late a beat may be before a flywheel goes on without it."""


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


class FlywheelClock:
    """For vehicles that fly whether or not anybody beats the time.

    The first tick is the order to start and is waited for. From then on beats are followed; when they stay away, ticks
    go on by the machine's monotonic clock, so that no process that dies takes the control of a flying vehicle with it.
    """

    def __init__(self, bus: Bus, tick_s: float, now_s: Callable[[], float] = time.monotonic) -> None:
        self._bus, self._tick_s, self._now_s = bus, tick_s, now_s
        self._ticks: deque[Tick] = deque()
        self._last: Tick | None = None
        self._newest = -1
        self._last_s = 0.0
        bus.on(topics.TICK, self._hear)

    def _hear(self, tick: Tick) -> None:
        if tick.tick > self._newest:
            self._newest = tick.tick
            self._ticks.append(tick)

    async def next_tick(self, timeout_s: float) -> Tick | None:
        wait_s = timeout_s
        if self._last is not None:
            due_s = self._last_s + (1 + LATE_TICKS) * self._tick_s
            wait_s = min(timeout_s, max(0.0, due_s - self._now_s()))
        if await self._bus.until(lambda: bool(self._ticks), wait_s):
            self._last = self._ticks.popleft()
            self._last_s = self._now_s()
            return self._last
        return self._go_on()

    def _go_on(self) -> Tick | None:
        """The tick that should have come; those of a time in which this process slept are passed over."""
        if self._last is None:
            return None
        missed = int((self._now_s() - self._last_s) / self._tick_s - LATE_TICKS + 1e-9)
        if missed < 1:
            return None
        number = self._last.tick + missed
        self._last = self._last.model_copy(
            update={"tick": number, "time_s": number * self._tick_s, "lockstep": False, "vehicles": ()}
        )
        self._last_s += missed * self._tick_s
        self._newest = number
        return self._last

    @property
    def backlog(self) -> int:
        return len(self._ticks)

    @property
    def is_gone(self) -> bool:
        """Never: what flies needs ticks until it has landed."""
        return False

    def now_s(self) -> float:
        return self._now_s()


def clock_of(mission: Mission, bus: Bus, *, lockstep: bool, now_s: Callable[[], float] = time.monotonic) -> Clock:
    """The one that fits the mission's vehicles."""
    if mission.vehicles.kind == "simulated":
        return SimulatorClock(bus, lockstep=lockstep, now_s=now_s)
    return FlywheelClock(bus, mission.tick_s, now_s)
