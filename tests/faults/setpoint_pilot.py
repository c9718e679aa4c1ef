"""One drone's control loop over MAVLink, for the benchmark of the setpoint path: decides at 20 Hz, and notes when.

``python -m faults.setpoint_pilot MISSION DRONE OUT`` takes off, flies for `FLIGHT_S`, lands, and writes what it sent
and when, by CLOCK_MONOTONIC, which the vehicle shares. Each velocity is a little different, to be found again.
"""

from __future__ import annotations

import asyncio
import json
import sys
import time
from pathlib import Path

import numpy as np

from agents.barriers import Neighbour
from agents.planners.coverage import CoverageController
from agents.vehicles.px4.vehicle import Px4Vehicle
from agents.vehicles.vehicle import Authority
from protocol.importance import SamplingTerms
from protocol.mission import Mission
from protocol.mission_file import load_mission

FLIGHT_S = 20.0
STEP_MPS = 1e-4
"""Between the velocities of two ticks; a setpoint travels as float32."""


async def fly(mission: Mission, drone: int) -> dict[str, object]:
    vehicle = Px4Vehicle(mission, drone, now_s=time.monotonic, events=lambda _level, _text: None)
    planner = CoverageController(mission, neighbours=3)
    planner.rehearse()
    others = [Neighbour(k, np.array([3.0 * k, 9.0, 2.0]), 0.0) for k in range(3)]
    solved: dict[str, float] = {}
    late = 0
    try:
        await vehicle.prepare()
        vehicle.take_off()
        await _until(vehicle, "ours")
        began = due = time.monotonic()
        tick = 0
        while due < began + FLIGHT_S:
            await asyncio.sleep(max(0.0, due - time.monotonic()))
            late += time.monotonic() - due > mission.tick_s / 2
            telemetry = vehicle.telemetry()
            assert telemetry is not None
            terms = SamplingTerms(
                np.array([300.0 * np.cos(tick / 20), 300.0 * np.sin(tick / 20), 0, 90.0, 9.0]), 20.0, 5.0
            )
            velocity = planner.decide(telemetry.pose, telemetry.velocity, others, terms, 3e4).velocity
            velocity[2] = STEP_MPS * (tick + 1 - FLIGHT_S / mission.tick_s / 2)
            solved[f"{vehicle_z(velocity[2])}"] = time.monotonic()
            vehicle.send(tick, velocity)
            tick += 1
            due += mission.tick_s
        vehicle.land()
        await _until(vehicle, "landed")
    finally:
        vehicle.close()
    return {"solved": solved, "late": late, "ticks": tick}


async def _until(vehicle: Px4Vehicle, authority: Authority) -> None:
    while vehicle.condition().authority != authority:  # noqa: ASYNC110  # it has no event to wait for
        await asyncio.sleep(0.05)


def vehicle_z(velocity_mps: float) -> int:
    """The number by which the two sides find a velocity again."""
    return round(velocity_mps / STEP_MPS)


if __name__ == "__main__":
    told = asyncio.run(fly(load_mission(Path(sys.argv[1])), int(sys.argv[2])))
    Path(sys.argv[3]).write_text(json.dumps(told))
