"""The way home and down ends on the ground, apart from all others, whoever meets whom."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.barriers import Neighbour, predicted_pose
from agents.homing import ARRIVED_M, STUCK_S, Homecoming, down_wish, home_wish
from agents.planners.coverage import CoverageController
from protocol.geometry import Floats
from protocol.mission import Drone, Flight, Mission

FLIGHT = Flight(lower_m=(-4.0, -4.0, 0.5), upper_m=(4.0, 4.0, 3.5))
TICK_S = 0.05
LANDED_M = 0.1


class Team:
    """Drones that follow the decided velocities at once, after the lag of the barriers' own model."""

    def __init__(self, starts: list[tuple[float, float]], places: list[Floats]) -> None:
        drones = tuple(Drone(id=k + 1, start=(*start, 1.5, 0.0, 1.3)) for k, start in enumerate(starts))
        self.mission = Mission(drones=drones, flight=FLIGHT)
        self.poses = [np.array([*place, 0.0, 1.3]) for place in places]
        self.velocities = [np.zeros(5) for _ in places]
        self.planners = [CoverageController(self.mission, len(places) - 1) for _ in places]
        self.landed = [False] * len(places)
        self.nearest = math.inf

    def step(self, *, home: bool) -> None:
        predicted = [predicted_pose(p, v, FLIGHT) for p, v in zip(self.poses, self.velocities, strict=True)]
        for k, planner in enumerate(self.planners):
            if self.landed[k]:
                continue
            others = [Neighbour(j + 1, predicted[j][:3], 0.0) for j in range(len(self.poses)) if j != k]
            wish = (
                home_wish(self.poses[k], self.mission.drones[k].start, others, FLIGHT.separation_m, 0.5)
                if home
                else down_wish(self.poses[k], others, FLIGHT.separation_m, 0.5)
            )
            command = planner.steer(self.poses[k], self.velocities[k], others, wish).velocity
            decay = math.exp(-TICK_S / FLIGHT.response_time_s)
            new = command + (self.velocities[k] - command) * decay
            self.poses[k] = self.poses[k] + TICK_S * (self.velocities[k] + new) / 2
            self.velocities[k] = new
            if self.poses[k][2] < FLIGHT.lower_m[2] + LANDED_M:
                self.landed[k], self.velocities[k] = True, np.zeros(5)
        pairs = itertools.combinations(self.poses, 2)
        self.nearest = min([self.nearest, *(float(np.linalg.norm(a[:3] - b[:3])) for a, b in pairs)])

    def fly(self, *, home: bool, limit_s: float = 120.0) -> None:
        for _ in range(round(limit_s / TICK_S)):
            if all(self.landed):
                return
            self.step(home=home)
        raise AssertionError(f"still in the air: {self.poses}")


def test_a_lone_drone_flies_home_and_comes_down_there() -> None:
    team = Team([(-2.0, 1.0)], [np.array([2.5, -2.0, 2.0])])
    team.fly(home=True)
    assert np.linalg.norm(team.poses[0][:2] - [-2.0, 1.0]) < 2 * ARRIVED_M


def test_two_that_must_change_places_head_on_both_get_home() -> None:
    team = Team([(-2.0, 0.0), (2.0, 0.0)], [np.array([2.0, 0.0, 2.0]), np.array([-2.0, 0.0, 2.0])])
    team.fly(home=True)
    assert team.nearest >= FLIGHT.separation_m
    for drone, pose in zip(team.mission.drones, team.poses, strict=True):
        assert np.linalg.norm(pose[:2] - drone.start[:2]) < 2 * ARRIVED_M


@settings(max_examples=10, deadline=None)
@given(order=st.permutations(range(4)), heights=st.lists(st.floats(1.0, 2.5), min_size=4, max_size=4))
def test_four_that_come_home_from_each_others_places_keep_their_distance(
    order: list[int], heights: list[float]
) -> None:
    corners = [(-2.0, -2.0), (2.0, -2.0), (2.0, 2.0), (-2.0, 2.0)]
    team = Team(corners, [np.array([*corners[k], z]) for k, z in zip(order, heights, strict=True)])
    team.fly(home=True)
    assert team.nearest >= FLIGHT.separation_m


@pytest.mark.parametrize("offset", [0.0, 0.02, 0.6])
def test_nobody_lands_on_whom_he_hovers_above(offset: float) -> None:
    team = Team([(0.0, 0.0), (1.5, 0.0)], [np.array([0.0, 0.0, 1.0]), np.array([offset, 0.0, 2.6])])
    team.fly(home=False)
    assert team.nearest >= FLIGHT.separation_m


STARTS = tuple(Drone(id=k + 1, start=(3.0 * k, 0.0, 2.0, 0.0, 1.3)) for k in range(2))


def stuck(at: Floats, others: list[Neighbour], *, home: bool = True) -> list[float]:
    """Moments at which a drone that never moves is told to land, asked every second of a minute."""
    mission = Mission(drones=STARTS, flight=FLIGHT)
    homecoming = Homecoming(mission, 1, CoverageController(mission, neighbours=1))
    moments = []
    for second in range(60):
        homecoming.steer(at, np.zeros(5), others, home=home, now_s=float(second))
        moments += [float(second)] if homecoming.landing else []
    return moments


@pytest.mark.parametrize("home", [True, False])
def test_who_comes_no_nearer_for_long_lands_where_it_is(*, home: bool) -> None:
    at = np.array([2.0, 0.0, 2.0, 0.0, 1.3])
    assert stuck(at, [], home=home)[0] == STUCK_S + 1
    silent = Neighbour(2, np.array([3.2, 0.0, 1.0]), age_s=900.0)
    assert stuck(at, [silent], home=home)[0] == STUCK_S + 1, "also when no way is found"


def test_nobody_lands_on_another_because_it_is_stuck() -> None:
    at = np.array([2.0, 0.0, 2.0, 0.0, 1.3])
    assert stuck(at, [Neighbour(2, np.array([2.5, 0.0, 0.0]), age_s=0.0)]) == []


def test_progress_or_another_task_in_between_starts_the_time_anew() -> None:
    mission = Mission(drones=STARTS, flight=FLIGHT)
    homecoming = Homecoming(mission, 1, CoverageController(mission, neighbours=1))

    def steer(x: float, now_s: float) -> bool:
        homecoming.steer(np.array([x, 0.0, 2.0, 0.0, 1.3]), np.zeros(5), [], home=True, now_s=now_s)
        return homecoming.landing

    assert not steer(2.0, 0.0)
    assert not steer(2.0, STUCK_S)
    assert not steer(1.9, STUCK_S + 1)
    assert not steer(1.9, 2 * STUCK_S)
    homecoming.put_off()
    assert not steer(1.9, 3 * STUCK_S)
    assert steer(1.9, 4 * STUCK_S + 0.1)
    assert steer(0.1, 5 * STUCK_S), "never taken back"
