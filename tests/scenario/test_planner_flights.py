"""Every planner flies the paper's field, alone and as a team of four: judged by the same importance, kept apart alike."""

from __future__ import annotations

import math
from typing import get_args

import pytest

from agents.planners.lawnmower import Lawnmower
from faults.team_flight import TeamFlight
from protocol.mission import Controller, Drone, Mission
from protocol.planner_settings import DOWNWARD, PlannerName

HALVED_S: dict[PlannerName, tuple[float, float]] = {
    "coverage": (103.0, 43.0),
    "lawnmower": (161.0, 51.0),
    "persistent": (154.0, 83.0),
    "angle_aware_down": (162.0, 51.0),
    "angle_aware": (144.0, 58.0),
}
"""Measured times to J = 0.5 of one drone and of four, from these starts; flights are chaotic."""


@pytest.mark.parametrize("drones", [1, 4])
@pytest.mark.parametrize("planner", get_args(PlannerName))
def test_importance_is_halved_in_the_planner_s_own_time_and_nobody_comes_too_near(
    planner: PlannerName, drones: int
) -> None:
    row = tuple(Drone(id=k + 1, start=(1.1 * k, 1.0, 2.0, 0.0, 1.3)) for k in range(drones))
    flight = TeamFlight(Mission(controller=Controller(planner=planner), drones=row))
    halved_s = HALVED_S[planner][drones > 1]

    assert flight.time_to(0.5, limit_s=1.3 * halved_s) == pytest.approx(halved_s, rel=0.3)

    assert drones == 1 or flight.min_separation >= flight.mission.flight.separation_m
    assert flight.outcomes.count("solved") > 0.99 * len(flight.outcomes)
    for body in flight.bodies:
        assert planner == "coverage" or body.pose[2] == pytest.approx(2.0, abs=0.02)
        assert planner not in DOWNWARD or body.pose[4] == pytest.approx(math.pi / 2, abs=0.01)


@pytest.mark.parametrize("drones", [1, 4, 7])
def test_a_team_of_lawnmowers_sweeps_its_parts_without_waiting_for_one_another_for_ever(drones: int) -> None:
    row = tuple(Drone(id=k + 1, start=(1.1 * k - 3.3, 1.0, 2.0, 0.0, 1.3)) for k in range(drones))
    flight = TeamFlight(Mission(controller=Controller(planner="lawnmower"), drones=row))
    planners = [planner for planner in flight.planners if isinstance(planner, Lawnmower)]
    for _ in range(round(320 / drones / flight.mission.tick_s) + 600):
        flight.step()

    assert min(planner.passes for planner in planners) >= 2
    assert sum(planner.left_out for planner in planners) <= drones
    assert drones == 1 or flight.min_separation >= 1.0
