"""Flies one random schedule, and says what must not have happened."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from agents.agent import Agent
from faults.garbage import Rubbish
from faults.link import Faults
from faults.monitor import Comparison, Monitor
from faults.schedule import FLIGHT_S, TELLING_S, Event, Kind, Schedule
from faults.scripted_mapper import marked
from faults.session import Session
from faults.team import Member, Team, flying
from faults.virtual_loop import Process, VirtualLoop, run
from ground_station.ground_station import GroundStation
from ground_station.journal import Journal
from protocol import topics
from protocol.bus import Bus
from protocol.errors import JournalError
from protocol.messages import Jump
from protocol.replication import Replication

IMPORTANCE_TARGET = 0.75
"""Below this the mean of phi must have fallen at the end, where drones can see; it starts at 1."""
LOOK_EVERY_TICKS = 5
"""How often every replica's jumps are counted."""
COMPARISONS = 3
"""Tries to catch all replicas at the same tick."""
START_S = 2.0
"""For the first tick to come, when a drone is late."""
END_S = 10.0
"""For all processes to end when the mission has."""
NOISE_PERIOD_S = 0.05


@dataclass(slots=True)
class Outcome:
    seed: int
    violations: list[str] = field(default_factory=list)
    separation_m: float = 0.0
    """Smallest; infinity for a single drone."""
    importance: float = 1.0
    """Mean of phi at the end, where drones can see."""
    jumps: int = 0
    comparison: Comparison | None = None
    digest: str = ""
    """Of all bytes that anybody received."""

    def __str__(self) -> str:
        equal = "-" if self.comparison is None else "bit-equal" if self.comparison.bit_equal else "within tolerance"
        return (
            f"seed {self.seed}: separation {self.separation_m:.3f} m, J {self.importance:.3f}, {self.jumps} jumps,"
            f" replicas {equal}"
        )


def fly(schedule: Schedule, folder: Path) -> Outcome:
    """Fly ``schedule`` in virtual time; ``folder`` is the ground station's run folder."""
    outcome = Outcome(schedule.seed)

    async def main() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        async with flying(schedule.mission, folder, schedule.seed) as team:
            await _Trial(schedule, team, outcome).run()
        outcome.violations += loop.failures

    with _logged(outcome.violations):
        try:
            run(main())
        except Exception as error:  # noqa: BLE001 - whatever it is, the next seed is to be flown too
            outcome.violations.append(f"the trial ended by {error!r}")
    return outcome


class _Trial:
    def __init__(self, schedule: Schedule, team: Team, outcome: Outcome) -> None:
        self._schedule, self._team, self._outcome = schedule, team, outcome
        self._marked = marked(team.field)
        self._heights: list[NDArray[np.float32]] = [np.ones(int(self._marked.sum()), np.float32)]
        """phi at the marked positions after so many jumps."""
        self._miscounting: set[str] = set()
        self._payloads: dict[str, bytes] = {}
        self._deadly: Event | None = None
        self._disk_full = False
        team.network.taps.append(self._overhear)
        process = Process("monitor")
        bus = process.call(lambda: Bus(team.network.session(process), lossless=False))  # type: ignore[arg-type]
        self._monitor: Monitor = process.call(Monitor, schedule.mission, bus)
        self._witness = process

    async def run(self) -> None:
        loop = asyncio.get_running_loop()
        late = {event.role for event in self._schedule.events if event.kind == "late join"}
        for role in self._team.roles:
            if role not in late:
                self._team.start(role)
        for event in self._schedule.events:
            loop.call_at(event.begin_s, self._begin, event)
            loop.call_at(event.end_s, self._end, event)
        with self._journalling():
            await asyncio.sleep(FLIGHT_S - loop.time())
            self._judge_lives()
            await self._compare()
            self._judge_replicas()
            await asyncio.sleep(FLIGHT_S + TELLING_S + END_S - loop.time())
            self._judge_end()

    def _note(self, violation: str) -> None:
        self._outcome.violations.append(violation)

    # --- faults --------------------------------------------------------------------------------------------------

    def _begin(self, event: Event) -> None:
        match event.kind:
            case "black hole":
                self._team.black_hole(event.role, active=True)
            case "freeze":
                self._team.stop(event.role)
            case "kill":
                self._team.kill(event.role)
            case "kill at jump":
                self._deadly = event
            case "reset":
                self._team.reset(event.role)
            case "skew":
                self._team.skew(event.role, int(event.strength))
            case "disk full":
                self._disk_full = True
            case "noise":
                self._noise = asyncio.create_task(self._make_noise(event))
            case "late join":
                pass
            case _:
                self._set_links(event.role, event.kind, event.strength)

    def _end(self, event: Event) -> None:
        match event.kind:
            case "black hole":
                self._team.black_hole(event.role, active=False)
            case "freeze":
                self._team.resume(event.role)
            case "kill" | "late join":
                self._team.start(event.role)
            case "kill at jump":
                self._deadly = None
                if event.role not in self._team.members:
                    self._team.start(event.role)
            case "skew":
                self._team.skew(event.role, 0)
            case "disk full":
                self._disk_full = False
            case "noise" | "reset":
                pass
            case _:
                self._set_links(event.role, event.kind, None)

    def _set_links(self, role: str, kind: Kind, strength: float | None) -> None:
        """``strength`` None: nothing is wrong any more."""
        name = {"delay": "delay_s", "reorder": "jitter_s", "narrow": "bytes_per_s"}.get(kind, kind)
        value: Any = getattr(Faults(), name) if strength is None else strength
        self._team.spoil(role, replace(self._team.faults(role), **{name: value}))

    async def _make_noise(self, event: Event) -> None:
        """Rubbish on every topic, in nobody's name."""
        session = self._team.network.session(Process(event.role))
        rubbish = Rubbish(self._team.dice)
        while asyncio.get_running_loop().time() < event.end_s:
            key = self._team.dice.choice(sorted(self._payloads))
            session.put(key, rubbish(key, self._payloads[key]), safe=False)
            await asyncio.sleep(NOISE_PERIOD_S)
        session.close()

    # --- what is seen on the way ---------------------------------------------------------------------------------

    def _overhear(self, sender: Session, key: str, payload: bytes) -> None:
        if sender.process.role == "stranger" or sender.process.dead:
            return
        self._payloads[key] = payload
        if key == topics.JUMP.key:
            if self._deadly is not None:
                self._team.kill(self._deadly.role)
                self._deadly = None
        elif key == topics.TICK.key and self._team.tick % LOOK_EVERY_TICKS == 0:
            self._count_jumps()

    @contextmanager
    def _journalling(self) -> Iterator[None]:
        """What the journal took has happened, whatever becomes of the ground station next; a full disk takes none."""
        append = Journal.append

        def take_note(journal: Journal, jump: Jump) -> bytes:
            if self._disk_full:
                raise JournalError("no space left on device")
            encoded = append(journal, jump)
            if jump.sequence != len(self._heights) - 1:
                self._note(f"jump {jump.sequence} came when there were {len(self._heights) - 1}")
            self._heights.append(self._heights[-1] + jump.increments[self._marked])
            return encoded

        with patch.object(Journal, "append", take_note):
            yield

    def _replications(self) -> Iterator[tuple[str, Replication]]:
        """Of those that live and have all of phi."""
        for role, member in self._team.members.items():
            if isinstance(member.shell, Agent | GroundStation) and member.shell._replication.whole:
                yield role, member.shell._replication

    def _count_jumps(self) -> None:
        """Where no drone sees, phi is 1 and all jumps taken so far: each once, to the bit."""
        for role, replication in self._replications():
            taken = replication.replica.jumps.taken
            if role in self._miscounting:
                continue
            if taken >= len(self._heights):
                self._note(f"{role} took {taken} jumps of {len(self._heights) - 1}")
                self._miscounting.add(role)
            elif (replication.replica.field.phi[self._marked] != self._heights[taken][:, None]).any():
                self._note(f"tick {self._team.tick}: {role} has not applied the first {taken} jumps once each")
                self._miscounting.add(role)

    # --- what is asserted at the end -----------------------------------------------------------------------------

    def _judge_lives(self) -> None:
        if self._team.tick < (FLIGHT_S - START_S) / self._schedule.mission.tick_s:
            self._note(f"only {self._team.tick} ticks were flown")
        for role, member in self._team.members.items():
            if member.task.done():
                self._note(f"{role} has ended: {_end_of(member)}")
        if not self._monitor.is_healed():
            replicas = {drone: state.tick for drone, state in self._monitor.replicas().items()}
            self._note(
                f"not healed at tick {self._team.tick}: alive {sorted(self._monitor.alive)}, replicas at {replicas}"
            )

    async def _compare(self) -> None:
        for _ in range(COMPARISONS):
            comparison = await self._witness.start(self._monitor.compare())
            if comparison is not None:
                self._outcome.comparison = comparison
                if comparison.worst_rms > self._schedule.mission.replication.tolerance:
                    self._note(f"replicas differ by {comparison.worst_rms:.2e}")
                return
        self._note("the replicas cannot be compared")

    def _judge_replicas(self) -> None:
        outcome, separation_m = self._outcome, self._schedule.mission.flight.separation_m
        outcome.jumps = len(self._heights) - 1
        outcome.separation_m = self._team.min_separation_m
        if outcome.separation_m < separation_m:
            self._note(f"drones came as near as {outcome.separation_m:.3f} m")
        self._count_jumps()
        for role, replication in self._replications():
            if replication.replica.jumps.next_sequence != outcome.jumps:
                self._note(f"{role} has {replication.replica.jumps.next_sequence} of {outcome.jumps} jumps")
            if role == "ground":
                outcome.importance = float(replication.replica.field.phi[~self._marked].mean())
        if outcome.importance > IMPORTANCE_TARGET:
            self._note(f"J is still {outcome.importance:.3f}")
        for contradiction in self._monitor.contradictions:
            self._note(contradiction)

    def _judge_end(self) -> None:
        self._outcome.digest = self._team.network.digest
        for role, member in self._team.members.items():
            end = _end_of(member)
            if end:
                self._note(f"{role} did not end well: {end}")
        for member in (*self._team.members.values(), *self._team.buried):
            if member.bus is not None and member.bus.statistics.failed:
                self._note(f"{member.role}: handlers failed: {dict(member.bus.statistics.failed)}")


def _end_of(member: Member) -> str:
    """How a process ended; empty if it did so without an error."""
    if not member.task.done():
        return "not at all"
    if member.task.cancelled():
        return "cancelled"
    error = member.task.exception()
    return "" if error is None else repr(error)


class _Collector(logging.Handler):
    def __init__(self, violations: list[str]) -> None:
        super().__init__(logging.ERROR)
        self._violations = violations

    def emit(self, record: logging.LogRecord) -> None:
        if record.exc_info is not None:
            self._violations.append(f"logged: {record.getMessage()}: {record.exc_info[1]!r}")


@contextmanager
def _logged(violations: list[str]) -> Iterator[None]:
    """Exceptions that the processes log become violations; the rest is not said."""
    root, collector = logging.getLogger(), _Collector(violations)
    level = root.level
    root.addHandler(collector)
    root.setLevel(logging.ERROR)
    try:
        yield
    finally:
        root.removeHandler(collector)
        root.setLevel(level)
