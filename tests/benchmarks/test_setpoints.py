"""From the solved program to the setpoint at a PX4-like vehicle, over MAVSDK and UDP, every agent a process."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from faults.px4_flight import free_ports
from faults.setpoint_pilot import vehicle_z
from protocol.mission_file import load_mission, mission_to_json
from sim_bridge.px4_endpoint.endpoint import Endpoint
from sim_bridge.px4_endpoint.guidance import Target

Record = Callable[..., None]
ROOT = Path(__file__).parents[2]
LIMIT_S = 150


@pytest.mark.timeout(200)
@pytest.mark.parametrize("drones", [1, 4])
def test_setpoint_path(drones: int, tmp_path: Path, record: Record) -> None:
    """Against the tick: how many times the 99th percentile fits into 50 ms."""
    url = f"udpin://127.0.0.1:{free_ports(drones)}"
    mission = load_mission(ROOT / "missions" / "px4.toml", drones=drones, replaced={"vehicles.url": url})
    path = tmp_path / "mission.json"
    path.write_text(mission_to_json(mission))
    arrivals: dict[int, dict[int, float]] = defaultdict(dict)

    def note(drone: int, at_s: float, target: Target) -> None:
        if target.velocity is not None:  # MAVSDK repeats each: the first one counts
            arrivals[drone].setdefault(vehicle_z(-target.velocity[2]), at_s)

    with Endpoint(mission) as endpoint:
        for vehicle in endpoint.vehicles.values():
            vehicle.on_setpoint = note
        outs = {drone.id: tmp_path / f"{drone.id}.json" for drone in mission.drones}
        environment = os.environ | {
            "PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}",
            "OMP_NUM_THREADS": "1",
            "NUMBA_NUM_THREADS": "1",
        }
        pilots = [
            subprocess.Popen([sys.executable, "-m", "faults.setpoint_pilot", path, str(drone), out], env=environment)
            for drone, out in outs.items()
        ]
        try:
            assert [pilot.wait(LIMIT_S) for pilot in pilots] == [0] * drones
        finally:
            for pilot in pilots:
                pilot.kill()
                pilot.wait()
    latencies, late, ticks = [], 0, 0
    for drone, out in outs.items():
        told = json.loads(out.read_text())
        late, ticks = late + told["late"], ticks + told["ticks"]
        latencies += [
            arrivals[drone][int(number)] - at_s
            for number, at_s in told["solved"].items()
            if int(number) in arrivals[drone]
        ]
    assert len(latencies) > 0.9 * ticks
    p50, p99 = np.percentile(latencies, [50, 99])
    record(f"setpoint_p50_{drones}", 1e3 * p50, "ms", "a tick of 50 ms", 0.05 / p50)
    record(f"setpoint_p99_{drones}", 1e3 * p99, "ms", "a tick of 50 ms", 0.05 / p99)
    record(f"setpoint_late_ticks_{drones}", 100 * late / ticks, "% of ticks", "half a tick late", late / ticks)
