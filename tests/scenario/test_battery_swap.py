"""A mission that takes three batteries a drone, in lockstep and as real processes: everybody swaps, nothing is lost."""

from __future__ import annotations

import itertools
import json
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from deploy.mission_run import fly
from deploy.plan_estimate import Plan, estimate
from faults.judgement import kept_keyframes
from faults.processes import write_scene
from ground_station.report.run_data import Run
from ground_station.report.run_folder import load_run
from protocol.messages import Status
from protocol.mission_file import load_mission

MISSION = """
name = "swap"
duration_s = 150
stop_below = 0.45
[target]
lower_m = [-1.2, -1.2, 0.0]
upper_m = [1.2, 1.2, 0.6]
[sensing]
decay_per_s = 0.1
[flight]
lower_m = [-2.0, -2.0, 0.5]
upper_m = [2.0, 2.0, 2.5]
speed_max_mps = 0.8
acceleration_max_mps2 = 6.0
[controller]
rate_hz = 10
coverage_rate_per_s = 0.02
[feedback]
method = "none"
[camera]
width_px = 160
height_px = 90
keyframe_baseline_m = 0.3
keyframe_angle_rad = 0.6
[reconstruction]
sweep_width_px = 80
depth_planes = 32
[recording]
enabled = false
report = false
[simulation]
scene = "{scene}"
[simulation.battery]
capacity_wh = 1.3
[vehicles]
battery_low = 0.12
battery_full_s = 40
reserve_factor = 2
battery_swap_s = 3
[[drones]]
id = 1
start = [-1.0, -0.8, 1.2, 0.0, 1.3]
[[drones]]
id = 2
start = [1.0, -0.8, 1.2, 3.0, 1.3]
[[drones]]
id = 5
start = [0.0, 1.0, 1.2, -1.5, 1.3]
"""


class Told:
    """Keeps what a run says."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def show(self, status: Status) -> None:
        """What it comes to is in the run's folder."""

    def say(self, text: str) -> None:
        self.said.append(text)

    def __enter__(self) -> Told:
        return self

    def __exit__(self, *_: object) -> None:
        return


@pytest.mark.processes
def test_three_drones_with_batteries_for_a_third_of_the_mission_finish_it_by_swapping(tmp_path: Path) -> None:
    """Policy "battery reserve"."""
    path = tmp_path / "swap.toml"
    path.write_text(MISSION.format(scene=write_scene(tmp_path)))
    told = Told()

    code = fly(load_mission(path), told, out=tmp_path, speed="max", started=datetime.now(UTC))

    assert code == 0, told.said
    folder = (tmp_path / "latest").resolve()
    run, summary = load_run(folder), json.loads((folder / "summary.json").read_text())
    plan = estimate(run)
    assert plan.reached, "J fell as far as it should"
    assert not plan.faults
    hover_s = run.mission.simulation.battery.hover_s
    assert plan.duration_s > 2.5 * hover_s, "a battery is for about a third of it"
    for drone in plan.drones:
        assert drone.batteries is not None
        assert drone.batteries >= 3
        assert drone.least_share is not None
        assert drone.least_share > run.mission.vehicles.battery_critical, "home before it is critical"
    assert nearest_m(run) >= run.mission.flight.separation_m
    assert kept_keyframes(folder) == summary["keyframes"] > 0
    assert summary["f_score_visible"] > 0.9, "and the map is whole"
    assert takes_over(run, plan), "others cover on while one is away"


def nearest_m(run: Run) -> float:
    """Of any two at any tick, those on the ground too."""
    assert run.flight is not None
    poses = run.flight.poses[:, :, :3]
    assert np.isfinite(poses).all(), "everybody is told of at every tick"
    pairs = itertools.combinations(range(poses.shape[1]), 2)
    return float(min(np.linalg.norm(poses[:, one] - poses[:, other], axis=1).min() for one, other in pairs))


def takes_over(run: Run, plan: Plan) -> bool:
    """Whether J fell in the times when a drone stood on the ground."""
    time_s, importance = run.curves["time_s"], run.curves["importance"]
    return all(
        np.interp(swap.end_s, time_s, importance) < np.interp(swap.start_s, time_s, importance)
        for drone in plan.drones
        for swap in drone.swaps
    )
