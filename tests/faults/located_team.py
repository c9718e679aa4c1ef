"""A team on the virtual network whose simulator has cameras and lidars, and whose scans are registered at once."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from concurrent.futures import Future
from contextlib import asynccontextmanager
from pathlib import Path
from unittest.mock import patch

from agents.localization.registrar import Job, answer
from agents.localization.registration import Registration, ScanRegistration
from faults.team import Team, flying
from ground_station.mapper import Mapper
from protocol.bus import Bus
from protocol.localization_settings import Lidar
from protocol.messages import DroneState, Keyframe
from protocol.mission import Mission
from sim_bridge.lidar import LidarSensor
from sim_bridge.photographer import Photographer
from sim_bridge.simulator import Simulator

POLL_S = 0.5


class AtOnce:
    """A registrar in this process, whose answers are there at once: what `RegistrarProcess` would say."""

    def __init__(self, lidar: Lidar) -> None:
        self._scans = ScanRegistration(lidar)

    def start(self) -> None:
        """Nothing to start."""

    def submit(self, job: Job) -> Future[Registration]:
        done: Future[Registration] = Future()
        done.set_result(answer(self._scans, job))
        return done

    def close(self) -> None:
        """Nothing to end."""


class LocatedTeam(Team):
    sensor: LidarSensor | None = None
    photographer: Photographer | None = None

    def __init__(self, mission: Mission, folder: Path, seed: int, *, lockstep: bool) -> None:
        super().__init__(mission, folder, seed, lockstep=lockstep)
        self.keyframes: list[Keyframe] = []
        """What came to the map, in its order; a real one takes threads, which have no place in virtual time."""

    def make_simulator(self, bus: Bus) -> Simulator:
        return Simulator(self.mission, bus, self.photographer, self.sensor, lockstep=self.lockstep)

    def make_mapper(self) -> Mapper:
        mapper = super().make_mapper()
        mapper.add = self.keyframes.extend  # type: ignore[method-assign]
        return mapper

    async def until_over(self) -> None:
        for role in self.roles:
            self.start(role)
        while not self.members["ground"].task.done():  # noqa: ASYNC110  # a task of another process of the virtual loop
            await asyncio.sleep(POLL_S)

    def truth(self, state: DroneState) -> tuple[float, ...]:
        """The pose of a drone at its state's tick."""
        simulator = self.members["sim"].shell
        assert isinstance(simulator, Simulator)
        assert simulator._believed is not None
        return tuple(simulator._believed._truths[state.tick][state.drone].tolist())


@asynccontextmanager
async def located(mission: Mission, folder: Path, seed: int) -> AsyncIterator[LocatedTeam]:
    """In lockstep."""
    with patch("agents.localization.lidar.RegistrarProcess", AtOnce):
        async with flying(mission, folder, seed, lockstep=True, kind=LocatedTeam) as team:
            assert isinstance(team, LocatedTeam)
            yield team
