"""What a plan says of a virtual flight, and which missions it refuses to fly."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from deploy.plan_estimate import Swap, describe, estimate, require_way_down, virtual
from deploy.plan_picture import draw_plan
from ground_station.report.run_data import Flight, Run
from protocol.battery_settings import Battery
from protocol.errors import MissionError, ProcessError
from protocol.mission import Drone, Mission, Simulation
from protocol.obstacle_settings import Obstacles
from protocol.vehicle_settings import Vehicles

TICK_S = 0.05
BATTERY = Battery(capacity_wh=20.0)


def mission(battery: Battery = BATTERY, stop_below: float = 0.25) -> Mission:
    drones = (Drone(id=2, start=(0.0, 0.0, 2.0, 0.0, 1.3)), Drone(id=4, start=(2.0, 0.0, 2.0, 0.0, 1.3)))
    return Mission(name="m", drones=drones, stop_below=stop_below, simulation=Simulation(battery=battery))


def run_of(
    mission: Mission,
    heights: Sequence[Sequence[float]],
    shares: Sequence[Sequence[float]],
    *,
    reason: str = "importance fell below 0.25",
    away_m: float = 0.0,
) -> Run:
    """Heights and shares (ticks, drones); the second drone is ``away_m`` beside its start."""
    ticks, drones = np.shape(heights)
    poses = np.zeros((ticks, drones, 5))
    poses[:, 1, 0], poses[:, :, 2] = 2.0 + away_m, heights
    none, words = np.zeros((ticks, drones)), np.full((ticks, drones), "flying")
    time_s = TICK_S * np.arange(ticks)
    numbers = [none] * 7
    flight = Flight(np.array([2, 4]), time_s, poses, *numbers, words, words, np.array(shares, dtype=float))
    summary: dict[str, Any] = {"exit_reason": reason, "J": 0.249, "sim_time_s": 0.25, "min_separation_m": 2.0}
    curves = {"time_s": time_s, "importance": np.linspace(1.0, 0.249, ticks)}
    return Run(mission, curves, flight, None, summary)


UP, DOWN = [2.0, 2.0], [2.0, 0.0]
HEIGHTS = [UP, UP, DOWN, DOWN, UP, UP]
SHARES = [[1.0, 1.0], [0.9, 0.8], [0.8, 0.4], [0.7, 1.0], [0.6, 0.9], [0.5, 0.8]]


def test_a_plan_has_flight_times_batteries_and_swaps_of_each_drone() -> None:
    plan = estimate(run_of(mission(), HEIGHTS, SHARES))

    first, second = plan.drones
    assert (first.drone, first.flight_s, first.batteries, first.least_share, first.swaps) == (2, 0.3, 1, 0.5, ())
    assert (second.flight_s, second.batteries, second.least_share) == (pytest.approx(0.2), 2, 0.8)
    assert second.swaps == (Swap(pytest.approx(0.1), pytest.approx(0.2)),)
    assert (plan.reached, plan.batteries, plan.nobody_s, plan.faults) == (True, 3, 0.0, [])
    assert "J < 0.25 after 0 s" in next(describe(plan))


def test_the_time_without_anybody_in_the_air_is_told() -> None:
    plan = estimate(run_of(mission(), [UP, [0.0, 0.0], [0.0, 0.0], UP], SHARES[:4]))
    assert plan.nobody_s == pytest.approx(0.1)


def test_endless_batteries_are_not_counted() -> None:
    plan = estimate(run_of(mission(Battery()), HEIGHTS, SHARES))
    assert plan.batteries is None
    assert "endless" in "\n".join(describe(plan))


def test_a_mission_that_does_not_get_to_its_j_says_how_far_it_gets() -> None:
    plan = estimate(run_of(mission(), HEIGHTS, SHARES, reason="duration of 0.25 s reached"))
    assert plan.faults == ["J 0.249 is as low as it gets, after 0 s, not 0.25: duration of 0.25 s reached"]
    assert not estimate(run_of(mission(stop_below=0.0), HEIGHTS, SHARES, reason="duration of 0.25 s reached")).faults


def test_a_drone_that_comes_down_elsewhere_is_a_fault() -> None:
    plan = estimate(run_of(mission(), HEIGHTS, SHARES, away_m=0.6))
    assert plan.faults == ["drone 4: its battery does not take it home: down at 2.6, 0.0 m after 0 s, 40% left"]
    assert not estimate(run_of(mission(), HEIGHTS, SHARES, away_m=0.4)).faults


def test_a_flight_that_was_cut_short_is_no_plan() -> None:
    run = run_of(mission(), HEIGHTS, SHARES)
    with pytest.raises(ProcessError, match="cut short"):
        estimate(Run(run.mission, run.curves, run.flight, None, None))


def test_the_picture_is_drawn(tmp_path: Path) -> None:
    run = run_of(mission(), HEIGHTS, SHARES)
    assert run.flight is not None
    draw_plan(estimate(run), run, run.flight, tmp_path / "plan.png")
    with Image.open(tmp_path / "plan.png") as picture:
        assert picture.size == (1440, 768)
        assert len(picture.convert("RGB").getcolors(1 << 20)) > 50, "something is on it"


def test_a_battery_that_cannot_reach_home_is_refused_before_the_flight() -> None:
    require_way_down(mission())
    require_way_down(mission(Battery()))
    with pytest.raises(
        MissionError, match=r"drone 2: 0\.5 Wh hover for 12 s.*its way down from 2 m.*cannot reach home"
    ):
        require_way_down(mission(Battery(capacity_wh=0.5)))


def test_the_virtual_flight_goes_through_an_empty_room_for_without_images_nothing_would_be_seen_free() -> None:
    among = mission().flight.model_copy(update={"obstacles": Obstacles(enabled=True)})
    assert not virtual(mission().model_copy(update={"flight": among})).flight.obstacles.enabled


def test_the_virtual_flight_has_no_images_and_carries_real_vehicles_by_the_simulator() -> None:
    real = mission(Battery()).model_copy(update={"vehicles": Vehicles(kind="px4", battery_full_s=600.0)})
    flown = virtual(real)
    assert (flown.vehicles.kind, flown.simulation.scene, flown.reconstruction.backend) == ("simulated", "", "none")
    assert flown.simulation.battery.hover_s == pytest.approx(600.0)
    assert flown.flight == real.flight
    assert virtual(mission(Battery())).simulation.battery.is_endless, "of simulated ones as the mission says"
