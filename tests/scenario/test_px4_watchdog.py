"""The event loop of a flying drone's process blocks: the watchdog's thread stops the vehicle, then leaves it to itself.

MAVSDK would go on repeating the last setpoint for ever, so the autopilot's own failsafe cannot notice.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from agents.vehicles.px4.vehicle import Px4Vehicle
from agents.watchdog import Watchdog
from faults.px4_flight import PATIENCE_S, px4_mission
from protocol.geometry import Floats
from sim_bridge.px4_endpoint.endpoint import Endpoint

pytestmark = pytest.mark.light

DRONE = 1
WISH = np.array([0.4, 0.0, 0.0, 0.0, 0.0])
PERIOD_S = 0.05
BLOCKED_S = 5.0
STOPPED_S = 1.0
"""For the vehicle to stop after the watchdog told it to."""


@dataclass
class Control:
    """A control task: sends and feeds the watchdog."""

    vehicle: Px4Vehicle
    watchdog: Watchdog
    autopilots: Endpoint

    async def fly_until(self, condition: str, seconds: float = 0.0) -> None:
        """``condition``: an authority that it waits for; then on for ``seconds``."""
        deadline_s, reached_s = time.monotonic() + PATIENCE_S, 0.0
        while not reached_s or time.monotonic() - reached_s < seconds:
            assert time.monotonic() < deadline_s, self.vehicle.condition()
            if not reached_s and self.vehicle.condition().authority == condition:
                reached_s = time.monotonic()
            self.vehicle.send(0, WISH)
            self.watchdog.feed()
            await asyncio.sleep(PERIOD_S)

    def speeds(self, from_s: float, to_s: float) -> Floats:
        """True speeds between two moments, m/s."""
        times, poses = self.autopilots.truth.poses()
        chosen = (times >= from_s) & (times <= to_s)
        steps = np.linalg.norm(np.diff(poses[chosen, 0, :3], axis=0), axis=1)
        return np.asarray(steps / np.diff(times[chosen]))


@asynccontextmanager
async def flying(folder: Path) -> AsyncIterator[Control]:
    mission = px4_mission(folder, 1)
    with Endpoint(mission) as autopilots:
        vehicle = Px4Vehicle(mission, DRONE, now_s=time.monotonic, events=lambda _level, _text: None)
        try:
            await vehicle.prepare()
            vehicle.take_off()
            watchdog = Watchdog(
                vehicle.stop,
                time.monotonic,
                mission.flight.setpoint_timeout_s,
                give_up=vehicle.hold,
                give_up_after_s=mission.vehicles.setpoint_lost_s,
            )
            with watchdog:
                yield Control(vehicle, watchdog, autopilots)
        finally:
            vehicle.close()


async def test_a_blocked_event_loop_stops_the_vehicle_and_then_holds_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))  # other tests of this machine fly the same system id
    async with flying(tmp_path) as control:
        there = control.autopilots.vehicles[DRONE]
        await control.fly_until("ours", seconds=2.0)
        assert there.mode.name == "OFFBOARD"

        began_s = time.monotonic()
        time.sleep(BLOCKED_S)  # noqa: ASYNC251  # nothing of the loop runs; the watchdog's thread does
        assert control.speeds(began_s - 0.5, began_s + 0.3).min() > 0.25, "it flew on, as MAVSDK repeats setpoints"
        timeout_s = 0.5
        assert control.speeds(began_s + timeout_s + STOPPED_S, began_s + BLOCKED_S).max() < 0.12
        assert there.mode.name == "HOLD"
        assert there.aircraft.commander.failsafe is None, "told to, not by a failsafe"
        assert (control.watchdog.stops, control.watchdog.given_up) == (1, 1)

        await control.fly_until("starting")
        await control.fly_until("ours", seconds=1.5)
        assert there.mode.name == "OFFBOARD"
        now_s = time.monotonic()
        assert control.speeds(now_s - 0.5, now_s).mean() > 0.25
        assert control.watchdog.stops == 1
