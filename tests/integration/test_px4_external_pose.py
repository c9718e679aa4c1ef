"""Poses from outside on their way to an autopilot: real MAVSDK, real MAVLink, our PX4-like endpoint's estimator."""

from __future__ import annotations

import asyncio
import contextlib
import math
import socket
import tempfile
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agents.localization.choice import make_pose_source
from agents.localization.motion_capture import MotionCapture
from agents.vehicles.px4.vehicle import Px4Vehicle
from agents.vehicles.vehicle import SeenPose, Telemetry
from protocol.bus import connect
from protocol.errors import VehicleError
from protocol.localization_settings import Localization
from protocol.mission import Drone, Mission
from protocol.vehicle_settings import Autopilot, Vehicles
from sim_bridge.px4_endpoint.capture import show
from sim_bridge.px4_endpoint.endpoint import Endpoint
from sim_bridge.px4_endpoint.frames import ned
from sim_bridge.px4_endpoint.vehicle import Vehicle

pytestmark = pytest.mark.light

DRONE = 3
START = (1.0, 2.0, 1.0, 2.5, 1.3)
RATE_HZ = 100.0
LATE_S = 0.04
PATIENCE_S = 20.0


@pytest.fixture(autouse=True)
def _own_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other tests of this machine fly the same system ids."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))


def mission(drift_mps: float, preflight_s: float = 30.0) -> Mission:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        url = f"udpin://127.0.0.1:{probe.getsockname()[1]}"
    return Mission(
        name="seen",
        localization=Localization(source="mocap"),
        drones=(Drone(id=DRONE, start=START),),
        vehicles=Vehicles(kind="px4", url=url, preflight_s=preflight_s),
        autopilot=Autopilot(drift_mps=drift_mps, satellites=False, position_noise_m=0.0),
    )


def vehicle_of(flown: Mission) -> Px4Vehicle:
    return Px4Vehicle(flown, DRONE, now_s=time.monotonic, events=lambda _level, _text: None)


def rotation_of(yaw: float) -> np.ndarray:
    cosine, sine = math.cos(yaw), math.sin(yaw)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


async def look(vehicle: Px4Vehicle, there: Vehicle) -> None:
    """As a capture that sees the vehicle's true place a hundred times a second, and says it late."""
    while True:
        pose, at_s = np.array(there.pose), time.monotonic()
        await asyncio.sleep(LATE_S)
        vehicle.aid(SeenPose(pose[:3], rotation_of(pose[3]), 0.002, 0.01, at_s))
        await asyncio.sleep(max(0.0, 1 / RATE_HZ - LATE_S))


@contextlib.asynccontextmanager
async def seen(flown: Mission) -> AsyncIterator[tuple[Vehicle, Px4Vehicle, asyncio.Task[None]]]:
    """A vehicle that is ready, seen from outside by several cameras that are not in step."""
    with Endpoint(flown) as endpoint:
        vehicle, there = vehicle_of(flown), endpoint.vehicles[DRONE]
        looking = asyncio.gather(*(look(vehicle, there) for _ in range(5)))
        try:
            await vehicle.prepare()
            yield there, vehicle, looking  # type: ignore[misc]  # cancelled like a task
        finally:
            looking.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await looking
            vehicle.close()


async def until(condition: Callable[[], bool], what: str) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline_s, what
        await asyncio.sleep(0.02)


def off_m(there: Vehicle) -> float:
    return math.dist(there.aircraft.estimate.position, ned(there.pose[:3]))


async def test_without_poses_a_vehicle_without_satellites_is_not_fit_to_fly_and_says_why() -> None:
    flown = mission(0.0, preflight_s=2.0)
    with Endpoint(flown):
        vehicle = vehicle_of(flown)
        try:
            with pytest.raises(VehicleError) as caught:
                await vehicle.prepare()
        finally:
            vehicle.close()
    assert "motion capture: no poses of this drone come" in str(caught.value)
    assert "not heard: position" in str(caught.value)


async def test_poses_bound_the_drift_of_the_autopilot_s_estimate_and_arrive_as_they_were_seen() -> None:
    async with seen(mission(drift_mps=0.1)) as (there, _, looking):
        heard: list[Any] = []
        handle = there._commands._handlers["VISION_POSITION_ESTIMATE"]

        def hear(packet: Any, now_s: float) -> Iterator[Any]:
            heard.append(packet)
            return handle(packet, now_s)

        there._commands._handlers["VISION_POSITION_ESTIMATE"] = hear
        await until(lambda: len(heard) > 60, "poses come")
        assert off_m(there) < 0.03
        span_s = (heard[-1].usec - heard[0].usec) / 1e6
        assert (len(heard) - 1) / span_s < 60.0, "no more than 50 a second, give or take what is late"
        packet = heard[-1]
        assert (packet.x, packet.y, packet.z) == pytest.approx((START[1], START[0], 0.0), abs=1e-3)
        assert (packet.roll, packet.pitch) == pytest.approx((0.0, 0.0), abs=1e-6)
        assert math.remainder(packet.yaw - (math.pi / 2 - START[3]), math.tau) == pytest.approx(0.0, abs=1e-3)
        covariance = packet.covariance
        assert [covariance[k] for k in (0, 6, 11)] == pytest.approx([0.002**2] * 3)
        assert [covariance[k] for k in (15, 18, 20)] == pytest.approx([0.01**2] * 3)

        looking.cancel()
        there.aircraft.estimator._drift = (0.1, 0.0, 0.0)
        await until(lambda: off_m(there) > 0.15, "it drifts without them")
        await until(lambda: not there.aircraft.has_position, "and knows in the end that it has no position")


async def test_from_the_capture_over_the_bus_and_mavlink_a_vehicle_flies_by_poses_and_knows_when_they_stop() -> None:
    """All but the planner: bus, the agent's source of poses, MAVSDK, and an estimator that drifts without."""
    flown = mission(drift_mps=0.1)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        router = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    vehicle, ended = vehicle_of(flown), threading.Event()
    async with connect(router, flown.name, router=True), connect(router, flown.name) as bus:
        source = make_pose_source(flown, DRONE, bus, lockstep=False, now_s=time.monotonic, aid=vehicle.aid)
        assert isinstance(source, MotionCapture)
        with Endpoint(flown) as endpoint:
            there = endpoint.vehicles[DRONE]
            showing = asyncio.create_task(show(flown, router, endpoint, ended))
            try:
                await vehicle.prepare()
                vehicle.take_off()
                began_s, tick, errors = time.monotonic(), 0, []

                async def flies(seconds: float, *, noted: bool) -> Telemetry:
                    nonlocal tick
                    ends_s = time.monotonic() + seconds
                    while True:
                        tick = max(tick + 1, int((time.monotonic() - began_s) / flown.tick_s))
                        located = await source.locate(tick, vehicle.telemetry())
                        assert located is not None
                        vehicle.send(tick, np.array([0.2, 0.0, 0.0, 0.0, 0.0]))
                        if noted:
                            errors.append(math.dist(located.pose[:3], there.pose[:3]))
                        if time.monotonic() > ends_s:
                            return located
                        await asyncio.sleep(flown.tick_s)

                located = await flies(0.1, noted=False)
                while vehicle.condition().authority != "ours" or located.position_sd_m > 0.05:
                    assert time.monotonic() < began_s + PATIENCE_S, (vehicle.condition(), source.counts)
                    located = await flies(0.1, noted=False)
                located = await flies(2.0, noted=True)
                assert np.median(errors) < 0.05
                assert off_m(there) < 0.1, "the autopilot's own"
                ended.set()
                await showing
                blind = await flies(3.0, noted=False)
                assert blind.position_sd_m > 3 * located.position_sd_m, "until policies hold and land"
                assert source.counts.taken > 20
            finally:
                showing.cancel()
                await asyncio.gather(showing, return_exceptions=True)
                source.close()
                vehicle.close()
