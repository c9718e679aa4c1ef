"""The bridge from a motion capture system: its library in a process of its own, the bus, and what comes between."""

from __future__ import annotations

import asyncio
import importlib.util
import multiprocessing
import socket
import sys
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import cast

import pytest

from ground_station.motion_capture.bridge import Bridge
from ground_station.motion_capture.eye import Eye, Failure, Frame, require_library
from protocol import topics
from protocol.bus import Bus, connect
from protocol.errors import ProcessError
from protocol.localization_settings import Localization, Mocap
from protocol.messages import ExternalPose, MissionPhase
from protocol.mission import Drone, Mission

pytestmark = pytest.mark.light
PATIENCE_S = 30.0
LEVEL = (1.0, 0.0, 0.0, 0.0)
DRONES = (Drone(id=1, start=(0.5, 1, 2, 0, 1.3)), Drone(id=4, start=(0, -1, 1.5, 0, 1.3), body="blue"))
has_library = pytest.mark.skipif(
    importlib.util.find_spec("motioncapture") is None, reason="the extra mocap is not installed"
)


def mission(system: str = "mock") -> Mission:
    capture = Mocap.model_validate({"system": system, "latency_s": 0.02})
    return Mission(localization=Localization(source="mocap"), mocap=capture, drones=DRONES)


@dataclass
class ScriptedEye:
    """Says what a test writes into it."""

    opened: list[ScriptedEye]

    def __post_init__(self) -> None:
        self.connection, self.told = multiprocessing.Pipe(duplex=False)
        self.opened.append(self)

    def close(self) -> None:
        self.connection.close()
        self.told.close()


async def until_opened(opened: list[ScriptedEye], count: int) -> None:
    async with asyncio.timeout(PATIENCE_S):
        while len(opened) < count:  # noqa: ASYNC110  # nothing tells
            await asyncio.sleep(0.01)


@dataclass
class Flight:
    drone: Bus
    bridge: asyncio.Task[None]
    poses: list[ExternalPose] = field(default_factory=list)

    async def until(self, condition: Callable[[], bool], what: str) -> None:
        assert await self.drone.until(condition, PATIENCE_S), what

    def finish(self) -> None:
        self.drone.put(topics.PHASE, MissionPhase(phase="finished", reason="enough"))


@asynccontextmanager
async def bridged(flown: Mission, open_eye: Callable[[Mission], Eye] = Eye) -> AsyncIterator[Flight]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    async with (
        connect(endpoint, flown.name, router=True),
        connect(endpoint, flown.name) as drone,
        connect(endpoint, flown.name) as bus,
    ):
        task = asyncio.create_task(Bridge(flown, bus, open_eye=open_eye).run())
        flight = Flight(drone, task)
        drone.on(topics.MOCAP, flight.poses.append)
        try:
            yield flight
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


@has_library
async def test_the_library_s_mock_is_passed_on_until_the_mission_is_over() -> None:
    async with bridged(mission()) as flight:
        await flight.until(lambda: {pose.drone for pose in flight.poses} == {1, 4}, "poses of both")
        by_drone = {pose.drone: pose for pose in flight.poses}
        assert by_drone[1].position == pytest.approx(DRONES[0].start[:3])
        assert by_drone[4].position == pytest.approx(DRONES[1].start[:3])
        assert by_drone[4].attitude == LEVEL
        assert 0.02 <= by_drone[4].age_s < 1.0
        flight.finish()
        await asyncio.wait_for(flight.bridge, PATIENCE_S)


async def test_a_system_that_fails_is_connected_to_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ground_station.motion_capture.bridge.RETRY_S", 0.05)
    opened: list[ScriptedEye] = []
    async with bridged(mission("vicon"), cast("Callable[[Mission], Eye]", lambda _: ScriptedEye(opened))) as flight:
        await until_opened(opened, 1)
        opened[0].told.send(Frame({"blue": ((1.0, 2.0, 3.0), LEVEL)}, time.monotonic()))
        await flight.until(lambda: any(pose.position == (1.0, 2.0, 3.0) for pose in flight.poses), "a pose")
        assert [pose.position for pose in flight.poses if pose.drone == 1] == [None]
        opened[0].told.send(Failure("unplugged"))
        await until_opened(opened, 2)
        opened[1].told.close()
        await until_opened(opened, 3)
        opened[2].told.send(Frame({"blue": ((4.0, 2.0, 3.0), LEVEL)}, time.monotonic()))
        await flight.until(lambda: any(pose.position == (4.0, 2.0, 3.0) for pose in flight.poses), "poses again")


async def test_a_system_that_falls_silent_is_connected_to_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ground_station.motion_capture.bridge.RETRY_S", 0.05)
    monkeypatch.setattr("ground_station.motion_capture.bridge.CONNECT_S", 0.2)
    opened: list[ScriptedEye] = []
    async with bridged(mission("vicon"), cast("Callable[[Mission], Eye]", lambda _: ScriptedEye(opened))):
        await until_opened(opened, 2)


def test_without_the_library_it_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "motioncapture", None)
    with pytest.raises(ProcessError, match=r"coverage-recon\[mocap\]"):
        require_library()
