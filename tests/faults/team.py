"""A whole mission in one process and in virtual time: the real Agent, GroundStation and Simulator on a bad network."""

from __future__ import annotations

import asyncio
import math
import random
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self, cast
from unittest.mock import patch

import numpy as np
import zenoh

from agents.agent import Agent
from agents.watchdog import CHECKS_PER_TIMEOUT, Watchdog
from faults.garbage import Rubbish, clock_ahead
from faults.link import Faults
from faults.network import Network
from faults.scripted_mapper import ScriptedMapper
from faults.session import Ring, Session
from faults.virtual_loop import Process
from ground_station.command_log import COMMANDS_FILE, CommandLog
from ground_station.ground_station import GroundStation
from ground_station.journal import JOURNAL_FILE, open_journal
from ground_station.mapper import Mapper
from ground_station.recording.recorder import Recorder
from ground_station.results import RunFolder
from protocol import topics
from protocol.aggregator import gather, is_gathered
from protocol.bus import Bus
from protocol.errors import CovreconError
from protocol.field import VirtualField
from protocol.messages import Tick
from protocol.mission import Mission
from protocol.wire import decode
from sim_bridge.simulator import Simulator


class TimerWatchdog(Watchdog):
    """Looks as often as the one with a thread, but by the loop's timers: so it is stopped with its process."""

    def __enter__(self) -> Self:
        self._timer = asyncio.get_running_loop().call_later(self._timeout_s / CHECKS_PER_TIMEOUT, self._look)
        return self

    def _look(self) -> None:
        try:
            self.check()
        except CovreconError:
            self.failures += 1
        self._timer = asyncio.get_running_loop().call_later(self._timeout_s / CHECKS_PER_TIMEOUT, self._look)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._timer.cancel()

    failures = 0
    """Times that the vehicle could not be told."""


@dataclass(slots=True)
class Member:
    """One process of the team, while it lives and after."""

    role: str
    process: Process
    session: Session
    task: asyncio.Task[None]
    bus: Bus | None = None
    shell: Agent | GroundStation | Simulator | None = None
    """Both None until it has started."""


class Team:
    """Roles are "ground", "sim" and "drone/<id>"; a role's links stay as bad as they are when it is started again."""

    def __init__(self, mission: Mission, folder: Path, seed: int, *, lockstep: bool) -> None:
        self.mission, self.lockstep = mission, lockstep
        self.field = VirtualField.of(mission.target)
        self.dice = random.Random(seed)
        self.network = Network(self.dice, Rubbish(self.dice))
        self.members: dict[str, Member] = {}
        self.buried: list[Member] = []
        """Those killed."""
        self.min_separation_m = math.inf
        """Smallest true distance of two vehicles at any tick."""
        self.tick = -1
        """The simulator's newest."""
        self._folder, self._seed = folder, seed
        self._faults: dict[str, Faults] = {}
        self.network.taps.append(self._observe)

    @property
    def roles(self) -> list[str]:
        return ["ground", "sim", *(f"drone/{drone.id}" for drone in self.mission.drones)]

    # --- processes -----------------------------------------------------------------------------------------------

    def route(self) -> Process:
        """The router's own part, which no bad link comes between."""
        process = Process("router")

        async def gather_or_idle() -> None:
            if is_gathered(self.mission, lockstep=self.lockstep):
                bus = Bus(self.network.session(process), lossless=False)  # type: ignore[arg-type]  # all that it uses
                await gather(bus, self.mission)

        process.start(gather_or_idle())
        return process

    def start(self, role: str) -> None:
        process = Process(role)
        session = self.network.session(process)
        session.up.faults = session.down.faults = self.faults(role)
        begin = {"ground": self._fly_ground, "sim": self._fly_simulator}.get(role, self._fly_agent)
        member = Member(role, process, session, process.start(self._live(role, begin)))
        self.members[role] = member

    async def _live(self, role: str, begin: Callable[[Member, Bus], Coroutine[Any, Any, None]]) -> None:
        member = self.members[role]
        member.bus = bus = Bus(member.session, lossless=self.lockstep)  # type: ignore[arg-type]  # all that it uses
        try:
            await begin(member, bus)
        finally:
            await bus.close()

    async def _fly_agent(self, member: Member, bus: Bus) -> None:
        drone = int(member.role.partition("/")[2])
        now_s = asyncio.get_running_loop().time
        agent = Agent(self.mission, drone, bus, lockstep=self.lockstep, now_s=now_s, watchdog=TimerWatchdog)
        member.shell = agent
        await agent.fly()

    async def _fly_simulator(self, member: Member, bus: Bus) -> None:
        simulator = self.make_simulator(bus)
        member.shell = simulator
        await simulator.run()

    def make_simulator(self, bus: Bus) -> Simulator:
        return Simulator(self.mission, bus, None, lockstep=self.lockstep)

    def make_mapper(self) -> Mapper:
        return cast("Mapper", ScriptedMapper(self.field, self._seed))

    async def _fly_ground(self, member: Member, bus: Bus) -> None:
        run = RunFolder(self._folder, self.mission)
        recorder = Recorder(None, self.mission, lossless=self.lockstep)
        commands = CommandLog(self._folder / COMMANDS_FILE)
        try:
            journal = open_journal(self._folder / JOURNAL_FILE)
            mapper = self.make_mapper()
            ground = GroundStation(self.mission, bus, run, journal, commands, mapper, recorder, lockstep=self.lockstep)
            member.shell = ground
            await ground.run()
        finally:
            commands.close()
            run.close()

    # --- faults --------------------------------------------------------------------------------------------------

    def faults(self, role: str) -> Faults:
        """What is wrong with both of a role's links."""
        return self._faults.get(role, Faults())

    def spoil(self, role: str, faults: Faults) -> None:
        self._faults[role] = faults
        if role in self.members:
            session = self.members[role].session
            session.up.faults = session.down.faults = faults

    def kill(self, role: str) -> None:
        """kill -9."""
        member = self.members.pop(role)
        self.network.kill(member.session)
        self.buried.append(member)

    def stop(self, role: str) -> None:
        self.network.stop(self.members[role].session)

    def resume(self, role: str) -> None:
        self.network.resume(self.members[role].session)

    def black_hole(self, role: str, *, active: bool) -> None:
        self.network.black_hole(self.members[role].session, active=active)

    def reset(self, role: str) -> None:
        self.network.reset(self.members[role].session)

    def skew(self, role: str, ticks: int) -> None:
        self.members[role].session.hears = clock_ahead(ticks) if ticks else None

    # --- what is seen --------------------------------------------------------------------------------------------

    def _observe(self, sender: Session, key: str, payload: bytes) -> None:
        """The simulator says the truth, before the network spoils it."""
        if key != topics.TICK.key or sender.process.role != "sim":
            return
        tick = decode(Tick, payload)
        self.tick = tick.tick
        places = np.array([(vehicle.truth or vehicle.pose)[:3] for vehicle in tick.vehicles])
        apart = np.linalg.norm(places[:, None] - places[None], axis=2)[np.triu_indices(len(places), 1)]
        self.min_separation_m = min(self.min_separation_m, *apart.tolist(), math.inf)

    def failed(self) -> list[str]:
        """Processes that ended by an error."""
        return [
            f"{role}: {member.task.exception()!r}"
            for role, member in self.members.items()
            if member.task.done() and not member.task.cancelled() and member.task.exception()
        ]


@asynccontextmanager
async def flying(
    mission: Mission, folder: Path, seed: int, *, lockstep: bool = False, kind: type[Team] = Team
) -> AsyncIterator[Team]:
    """A team of which nobody has started; at the end all its processes are ended."""
    team = kind(mission, folder, seed, lockstep=lockstep)
    with (
        patch.object(zenoh.handlers, "RingChannel", Ring),
        # The journal's epoch is drawn at random; here, the same in every run of a seed.
        patch("secrets.randbits", team.dice.getrandbits),
        patch("ground_station.report.write_report"),
    ):
        router = team.route()
        try:
            yield team
        finally:
            for process in (router, *(member.process for member in (*team.members.values(), *team.buried))):
                await process.bury()
