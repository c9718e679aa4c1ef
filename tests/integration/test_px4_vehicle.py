"""`Px4Vehicle` against our PX4-like endpoint, over MAVLink: from the checks to the landing, and what goes wrong."""

from __future__ import annotations

import asyncio
import contextlib
import math
import socket
import tempfile
import threading
import time
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agents.vehicles.px4.vehicle import Px4Vehicle
from agents.vehicles.vehicle import Telemetry
from protocol.errors import VehicleError
from protocol.geometry import camera_rotation
from protocol.mission import Drone, Mission
from protocol.vehicle_settings import Autopilot, Parameter, Vehicles
from sim_bridge.px4_endpoint.endpoint import Endpoint
from sim_bridge.px4_endpoint.vehicle import Vehicle

pytestmark = pytest.mark.light

DRONE = 3
START = (1.0, 2.0, 1.0, 2.5, 1.3)
PATIENCE_S = 20.0
PERIOD_S = 0.05
STILL = np.zeros(5)


@dataclass
class Trial:
    """One vehicle, and what flies it."""

    mission: Mission
    there: Vehicle
    flown: Px4Vehicle
    events: list[tuple[str, str]] = field(default_factory=list)

    async def until(self, condition: Callable[[], bool], velocity: np.ndarray | None = None) -> None:
        """Meanwhile the control task sends ``velocity``, or nothing."""
        deadline_s = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline_s, (self.flown.condition(), self.there.mode, self.events)
            if velocity is not None:
                self.flown.send(0, velocity)
            await asyncio.sleep(PERIOD_S)

    async def until_authority(self, authority: str, velocity: np.ndarray | None = None) -> None:
        await self.until(lambda: self.flown.condition().authority == authority, velocity)

    async def fly(self, velocity: list[float], seconds: float) -> list[np.ndarray]:
        """What was really sent."""
        ends_s, sent = time.monotonic() + seconds, []
        while time.monotonic() < ends_s:
            sent.append(self.flown.send(0, np.array(velocity)))
            await asyncio.sleep(PERIOD_S)
        return sent

    @property
    def telemetry(self) -> Telemetry:
        told = self.flown.telemetry()
        assert told is not None
        return told

    def heard(self, text: str) -> bool:
        return any(text in said for _, said in self.events)


@pytest.fixture(autouse=True)
def _own_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other tests of this machine fly the same system ids."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))


def mission(**settings: Any) -> Mission:
    """One drone, on a vehicle that is in a hurry."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        url = f"udpin://127.0.0.1:{probe.getsockname()[1]}"
    hurry = (Parameter(name="MPC_TKO_RAMP_T", value=0.3), Parameter(name="COM_DISARM_LAND", value=0.5))
    vehicles = {"origin": (47.4, 8.5, 400.0), "parameters": hurry, **settings}
    return Mission(
        name="trial",
        drones=(Drone(id=DRONE, start=START),),
        vehicles=Vehicles(kind="px4", url=url, **vehicles),
        autopilot=Autopilot(spool_up_s=0.1),
    )


@contextlib.asynccontextmanager
async def trial(flown: Mission) -> AsyncIterator[Trial]:
    with Endpoint(flown) as endpoint:
        events: list[tuple[str, str]] = []
        vehicle = vehicle_of(flown, events)
        try:
            await vehicle.prepare()
            yield Trial(flown, endpoint.vehicles[DRONE], vehicle, events)
        finally:
            vehicle.close()


def vehicle_of(flown: Mission, events: list[tuple[str, str]]) -> Px4Vehicle:
    return Px4Vehicle(flown, DRONE, now_s=time.monotonic, events=lambda level, text: events.append((level, text)))


@contextlib.asynccontextmanager
async def in_the_air(**settings: Any) -> AsyncIterator[Trial]:
    async with trial(mission(**settings)) as flight:
        flight.flown.take_off()
        await flight.until_authority("ours")
        yield flight


async def test_a_flight_from_the_checks_to_the_landing() -> None:
    async with trial(mission()) as flight:
        assert flight.flown.condition().authority == "ready"
        assert flight.heard("preflight, on the ground")
        assert flight.heard("COM_OBL_RC_ACT: 0 -> 5")
        assert flight.telemetry.pose[:2] == pytest.approx(START[:2], abs=0.3)
        assert flight.flown.send(0, np.ones(5)).tolist() == [0.0] * 5, "not before it is ours"
        flight.flown.take_off()
        await flight.until_authority("ours")
        assert flight.telemetry.pose[2] == pytest.approx(START[2], abs=0.4)
        assert flight.telemetry.pose[3:] == pytest.approx(START[3:], abs=0.1)

        before = np.array(flight.there.pose)
        sent = await flight.fly([0.4, -0.2, 0.1, 0.4, -0.1], 2.0)
        after = np.array(flight.there.pose)
        assert sent[5] == pytest.approx([0.4, -0.2, 0.1, 0.4, -0.1], abs=1e-6)
        moved = after - before
        moved[3] = math.remainder(moved[3], 2 * math.pi)  # it turned through west
        assert moved == pytest.approx([0.8, -0.4, 0.2, 0.8, -0.2], abs=0.15)
        told = flight.telemetry
        assert told.pose == pytest.approx(after, abs=0.15)
        assert told.velocity == pytest.approx([0.4, -0.2, 0.1, 0.4, -0.1], abs=0.1)
        assert time.monotonic() - told.stamp_s < 0.3
        assert (told.battery > 0.9, told.rotation) == (True, None)

        assert flight.flown.send(0, np.full(5, 9.0))[:3].tolist() == [0.5] * 3, "what was really sent is told"
        flight.flown.stop()
        await flight.until(lambda: bool(np.abs(flight.telemetry.velocity[:3]).max() < 0.1))
        flight.flown.land()
        assert flight.flown.condition().authority == "landing"
        await flight.until_authority("landed", np.ones(5))
        assert not flight.there.armed
        flight.flown.take_off()
        flight.flown.leave(hold=True)
        assert flight.flown.condition().authority == "landed"
    flight.flown.close()


async def test_a_pilot_takes_over_and_gives_back() -> None:
    async with in_the_air() as flight:
        await flight.fly([0.2, 0.0, 0.0, 0.0, 0.0], 0.5)
        flight.there.pilot("POSCTL", (0.0, 0.3, 0.0))
        await flight.until_authority("yielded", STILL)
        assert "a pilot switched to POSCTL" in flight.flown.condition().reason

        before = np.array(flight.there.pose)
        sent = await flight.fly([0.4, 0.0, 0.0, 0.0, 0.0], 3.5)  # longer than MAVSDK repeats setpoints by itself
        flight.flown.stop()
        flight.flown.hold()
        await asyncio.to_thread(flight.flown.hold)
        moved = np.array(flight.there.pose) - before
        assert not np.any(sent)
        assert flight.there.mode.name == "POSCTL"
        assert moved[1] > 0.7 > 0.1 > abs(moved[0])

        flight.there.pilot("OFFBOARD")
        await flight.until_authority("ours", STILL)
        assert np.any((await flight.fly([0.4, 0.0, 0.0, 0.0, 0.0], 0.5))[-1])


async def test_a_failsafe_after_a_silence_of_ours_or_of_the_link_is_no_take_over() -> None:
    async with in_the_air(telemetry_lost_s=1.5) as flight:
        await flight.fly([0.1, 0.0, 0.0, 0.0, 0.0], 0.3)
        time.sleep(1.2)  # noqa: ASYNC251  # nothing of ours runs, and PX4 falls into HOLD
        flight.there.pilot("HOLD")
        await flight.until_authority("starting", STILL)
        assert "in our setpoints" in flight.flown.condition().reason
        await flight.until_authority("ours", STILL)
        assert flight.there.mode.name == "OFFBOARD"

        flight.there.cut = True
        await flight.until_authority("lost", STILL)
        await flight.until(lambda: flight.there.mode.name == "HOLD", STILL)
        assert flight.flown.send(0, np.ones(5)).tolist() == [0.0] * 5
        flight.there.cut = False
        await flight.until_authority("ours", STILL)
        await flight.fly([0.1, 0.0, 0.0, 0.0, 0.0], 1.5)
        assert flight.flown.condition().authority == "ours"


async def test_a_watchdog_holds_the_vehicle_while_the_event_loop_is_blocked() -> None:
    async with in_the_air() as flight:
        await flight.fly([0.4, 0.0, 0.0, 0.0, 0.0], 0.5)
        took_s: list[float] = []

        def watch() -> None:
            began_s = time.monotonic()
            flight.flown.stop()
            flight.flown.hold()
            took_s.append(time.monotonic() - began_s)

        watchdog = threading.Thread(target=watch)
        watchdog.start()
        watchdog.join()  # the loop is blocked until then, and for long enough for a heartbeat
        time.sleep(1.2)  # noqa: ASYNC251  # the loop is blocked on purpose
        assert flight.there.mode.name == "HOLD"
        assert took_s[0] < 1.0
        await asyncio.sleep(0.2)
        assert flight.flown.condition().authority == "ours"
        assert not flight.heard("yielded")

        flight.flown.send(0, STILL)
        assert flight.flown.condition().authority == "starting"
        await flight.until(lambda: flight.there.mode.name == "OFFBOARD", STILL)
        await flight.until_authority("ours", STILL)


async def test_a_restart_in_the_air_goes_on_without_a_take_off() -> None:
    async with in_the_air() as flight:
        flight.flown.close()
        assert flight.flown.telemetry() is None
        await asyncio.sleep(0)
        height = flight.there.pose[2]
        again = vehicle_of(flight.mission, flight.events)
        try:
            await again.prepare()
            assert again.condition().authority == "ready"
            assert flight.heard("preflight, in the air")
            assert flight.there.mode.name == "HOLD"
            again.take_off()
            flight.flown = again
            await flight.until_authority("ours")
            assert flight.there.pose[2] == pytest.approx(height, abs=0.4)
            await asyncio.to_thread(again.land)
            await flight.until_authority("landed")
        finally:
            again.close()


async def test_a_gimbal_turns_without_the_vehicle_and_is_lost_when_it_is_stuck_or_silent() -> None:
    async with in_the_air(camera_mount="gimbal", gimbal_lost_s=0.6, gimbal_error_rad=0.2) as flight:
        heading = flight.there.aircraft.body.yaw
        before = np.array(flight.there.pose)
        await flight.fly([0.0, 0.0, 0.0, 0.4, -0.1], 1.5)
        moved = np.array(flight.there.pose) - before
        assert [math.remainder(moved[3], 2 * math.pi), moved[4]] == pytest.approx([0.6, -0.15], abs=0.15)
        assert flight.there.aircraft.body.yaw == pytest.approx(heading, abs=0.05)
        assert math.remainder(flight.telemetry.pose[3] - flight.there.pose[3], 2 * math.pi) == pytest.approx(0, abs=0.1)

        assert not flight.flown.condition().gimbal_lost
        flight.there.gimbal_stuck = True
        await flight.until(lambda: flight.flown.condition().gimbal_lost, np.array([0.0, 0.0, 0.0, 0.5, 0.5]))
        assert flight.heard("gimbal lost: ")
        assert flight.heard("degrees from where it is told to point")
        flight.there.gimbal_stuck = False
        await flight.until(lambda: not flight.flown.condition().gimbal_lost, STILL)
        flight.there.gimbal_silent = True
        await flight.until(lambda: flight.flown.condition().gimbal_lost, STILL)
        assert flight.heard("gimbal lost: not heard for 0.6 s")


async def test_an_estimate_that_jumps_is_counted_and_offboard_refused_is_said() -> None:
    async with trial(mission(camera_mount="fixed")) as flight:
        flight.there.refuse_offboard = True
        flight.flown.take_off()
        await flight.until(lambda: "offboard was acknowledged, but" in flight.flown.condition().reason)
        assert flight.flown.condition().authority == "starting"
        assert flight.heard("Switching to Offboard is currently not available")
        flight.there.refuse_offboard = False
        await flight.until_authority("ours")

        assert flight.flown.condition().jumps == 0
        flight.there.jump((1.0, 0.0, 0.0))
        await flight.until(lambda: flight.flown.condition().jumps == 1)

        sent = (await flight.fly([0.0, 0.0, 0.0, 0.3, 0.3], 0.5))[-1]
        assert sent[3:] == pytest.approx([0.3, 0.0], abs=1e-6), "a fixed camera does not pitch"
        told = flight.telemetry
        assert told.rotation is not None
        assert told.rotation == pytest.approx(camera_rotation(*told.pose[3:]), abs=0.2)
        assert told.pose[4] == START[4]


async def test_what_is_not_fit_to_fly_is_refused_with_every_reason() -> None:
    settings = {"preflight_s": 1.0, "parameters": (Parameter(name="NO_SUCH_THING", value=1.5),)}
    grounded = mission(**settings)
    with Endpoint(grounded) as endpoint:
        endpoint.vehicles[DRONE].fail_checks("gyro")
        endpoint.vehicles[DRONE].set_battery(0.1)
        vehicle = vehicle_of(grounded, [])
        with pytest.raises(VehicleError) as refused:
            await vehicle.prepare()
        vehicle.close()

    lines = str(refused.value).splitlines()
    assert lines[0] == f"drone {DRONE} is not fit to fly:"
    assert "parameters: NO_SUCH_THING: this vehicle has no such parameter, or does not answer" in lines[1]
    named = {line.split(":")[0].strip() for line in lines[1:]}
    assert {"parameters", "gyroscope", "armable", "battery"} <= named
