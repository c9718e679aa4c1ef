"""What a flight over many hosts looked like from the ground computer: how old states came, J, modes, traffic, CPU."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from faults.hosts import Hosts
from faults.judgement import Figures
from faults.processes import Flight
from protocol import topics
from protocol.bus import Bus
from protocol.messages import DroneState, Tick

HEARD_TICKS = 10
"""A drone whose newest state is older is not heard now."""


@dataclass(frozen=True, slots=True)
class Heard:
    """One state as it came in."""

    tick: int
    drone: int
    age_s: float
    """Since its tick was heard in the same place: the way of the tick to the drone, its work, and the way back."""
    importance: float
    """J of that drone's replica."""
    mode: str


@dataclass(frozen=True, slots=True)
class _Reading:
    """What had been used up at one moment."""

    tick: int
    time_s: float
    traffic: dict[str, tuple[int, int]]
    """Bytes up and down, by drone."""
    cpu_s: dict[str, float]
    """By process."""


@dataclass(frozen=True, slots=True)
class Phase:
    """A part of the flight."""

    name: str
    begin: _Reading
    end: _Reading


@dataclass
class FleetLog:
    flight: Flight
    hosts: Hosts
    bus: Bus
    heard: list[Heard] = field(default_factory=list)
    phases: list[Phase] = field(default_factory=list)
    _ticks: dict[int, float] = field(default_factory=dict)
    _newest: dict[int, Heard] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._now_s = asyncio.get_running_loop().time
        self.bus.on(topics.TICK, self._hear_tick)
        self.bus.on(topics.STATE, self._hear_state)

    def _hear_tick(self, tick: Tick) -> None:
        self._ticks.setdefault(tick.tick, self._now_s())

    def _hear_state(self, state: DroneState) -> None:
        if state.tick in self._ticks:
            age_s = self._now_s() - self._ticks[state.tick]
            self._newest[state.drone] = Heard(state.tick, state.drone, age_s, state.importance, state.mode)
            self.heard.append(self._newest[state.drone])

    def flies(self, drone: int) -> bool:
        """Whether it says so now."""
        newest = self._newest.get(drone)
        recent = newest is not None and newest.tick > self.flight.monitor.tick - HEARD_TICKS
        return newest is not None and recent and newest.mode == "flying"

    def importance_at(self, tick: int) -> float:
        """J as the state that came last before the end of ``tick`` has it."""
        return next(each.importance for each in reversed(self.heard) if each.tick <= tick)

    @asynccontextmanager
    async def phase(self, name: str) -> AsyncIterator[None]:
        begin = await self._read()
        yield
        self.phases.append(Phase(name, begin, await self._read()))

    async def _read(self) -> _Reading:
        traffic = await asyncio.to_thread(self._count)  # it starts programs, and ticks are to be stamped meanwhile
        cpu_s = {"watcher": time.process_time()}
        cpu_s |= {name: _cpu_s(self.flight.pid(name)) for name in self.flight.running}
        return _Reading(self.flight.monitor.tick, self._now_s(), traffic, cpu_s)

    def _count(self) -> dict[str, tuple[int, int]]:
        return {name: (self.hosts.bytes_up(name), self.hosts.bytes_down(name)) for name in self.flight.drones}

    # --- figures -------------------------------------------------------------------------------------------------

    def figures(self) -> Figures:
        first, last = self.heard[0], self.heard[-1]
        told: Figures = {"J": {"start": round(first.importance, 3), "end": round(last.importance, 3)}}
        return told | {phase.name: self._figures_of(phase) for phase in self.phases}

    def _figures_of(self, phase: Phase) -> Figures:
        begin, end = phase.begin, phase.end
        heard = [each for each in self.heard if begin.tick < each.tick <= end.tick]
        took_s = end.time_s - begin.time_s
        rates = {
            name: [
                round((after - before) / took_s / 1e3, 1)
                for before, after in zip(begin.traffic[name], now, strict=True)
            ]
            for name, now in end.traffic.items()
        }
        cpu = {
            name: round(100 * (now - begin.cpu_s[name]) / took_s, 1)
            for name, now in end.cpu_s.items()
            if name in begin.cpu_s
        }
        p50, p99 = np.percentile([each.age_s for each in heard], [50, 99]) * 1e3
        return {
            "seconds": round(took_s, 1),
            "J": round(heard[-1].importance, 3),
            "up_and_down_kB_per_s": rates,
            "cpu_percent": cpu,
            "state_age_ms": {"p50": round(p50, 1), "p99": round(p99, 1)},
            "braking_percent": {name: _braking(heard, int(name.removeprefix("drone-"))) for name in self.flight.drones},
        }


def _braking(heard: list[Heard], drone: int) -> float | None:
    """Share of a drone's states that say so; None if there are none."""
    modes = [each.mode for each in heard if each.drone == drone]
    return round(100 * modes.count("braking") / len(modes), 1) if modes else None


def _cpu_s(pid: int) -> float:
    """User and system time of a process."""
    # "pid (name) state ...": they are the 12th and 13th field behind the name.
    fields = Path("/proc", str(pid), "stat").read_text().rpartition(") ")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
