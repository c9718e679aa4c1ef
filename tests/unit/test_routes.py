"""Ways around zones keep clear of them, and lead home wherever there is a way."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest

from agents.homing import STUCK_S, Homecoming
from agents.pathway import Pathway
from agents.planners.choice import make_planner
from faults.zones import TABLE, distance_m, l_shaped, random_flight, starts
from protocol.airspace import airspace_of
from protocol.geometry import Floats
from protocol.mission import Drone, Flight, Mission
from protocol.routes import SPARE_M, Routes, routes_of
from sim_bridge.dynamics import VehicleBody

FLIGHT = l_shaped()
WALL: dict[str, Any] = {"name": "wall", "polygon": ((-0.2, -4.0), (0.2, -4.0), (0.2, 4.0), (-0.2, 4.0))}


def routes(flight: Flight) -> Routes:
    found = routes_of(flight)
    assert found is not None
    return found


def least_distance_m(flight: Flight, way: list[Floats]) -> float:
    legs = [one + (other - one) * share for one, other in itertools.pairwise(way) for share in np.linspace(0, 1, 30)]
    return min(distance_m(flight, point) for point in legs)


def test_within_a_convex_boundary_every_way_is_straight() -> None:
    assert routes_of(Flight(boundary=((-3.5, -3.5), (3.5, -3.5), (3.5, 3.5), (-3.5, 3.5)))) is None


def test_without_zones_there_is_nothing_to_ask() -> None:
    assert routes_of(Flight()) is None
    assert Pathway(Flight()).leg(np.zeros(3), np.ones(2)) is None


def test_a_way_leads_around_the_inner_corner_and_keeps_its_distance() -> None:
    start, goal = np.array([-1.0, 3.0, 2.0]), np.array([3.0, -1.0])
    way = routes(FLIGHT).way(start, goal)
    assert way is not None
    assert not routes(FLIGHT).is_clear(start, np.array([*goal, 2.0]))
    assert way[-1][:2].tolist() == goal.tolist()
    assert routes(FLIGHT).levels[0].low_m <= way[-1][2] <= routes(FLIGHT).levels[0].high_m, "where one can land"
    wide = airspace_of(FLIGHT).wide_m
    assert wide <= least_distance_m(FLIGHT, [start, *way]) < wide + 2 * SPARE_M
    length = sum(math.dist(a[:2], b[:2]) for a, b in itertools.pairwise([start, *way]))
    assert length < math.dist(start[:2], (-wide, -wide)) + math.dist((-wide, -wide), goal) + 0.1, "a shortest one"


@pytest.mark.parametrize(("z", "over"), [(0.9, False), (1.7, True)])
def test_what_lies_below_is_not_in_the_way(z: float, over: bool) -> None:
    way = routes(FLIGHT).way(np.array([-3.0, -1.9, z]), np.array([-0.5, -1.9]))
    assert way is not None
    assert (len({(round(p[0], 2), round(p[1], 2)) for p in way}) == 1) == over


def test_a_wall_is_crossed_where_it_is_open_and_nowhere_else() -> None:
    start, goal = np.array([-2.0, 0.0, 1.0]), np.array([2.0, 0.0])
    assert routes(Flight(no_fly=(WALL,))).way(start, goal) is None  # type: ignore[arg-type]
    over = Flight(no_fly=({**WALL, "upper_m": 3.0},))  # type: ignore[arg-type]
    way = routes(over).way(start, goal)
    assert way is not None
    assert max(point[2] for point in way) == pytest.approx(3.0 + airspace_of(over).wide_m, abs=2 * SPARE_M)
    assert least_distance_m(over, [start, *way]) >= airspace_of(over).wide_m
    under = Flight(no_fly=({**WALL, "lower_m": 2.0},))  # type: ignore[arg-type]
    way = routes(under).way(np.array([-2.0, 0.0, 4.0]), goal)
    assert way is not None
    assert min(point[2] for point in way) <= 2.0 - airspace_of(under).wide_m


def test_the_way_down_from_above_a_table_leads_beside_it() -> None:
    start = np.array([-1.8, -1.9, 2.5])
    assert not routes(FLIGHT).may_descend(start)
    way = routes(FLIGHT).way(start, None)
    assert way is not None
    assert routes(FLIGHT).may_descend(way[-1])
    assert math.dist(way[-1][:2], start[:2]) < 2.0
    assert routes(FLIGHT).may_descend(np.array([-3.5, 0.0, 3.0]))


class Flown:
    """One drone that follows the decided velocities with the lag of the barriers' own model."""

    def __init__(self, flight: Flight, home: tuple[float, ...], place: Floats, planner: str = "coverage") -> None:
        drone = Drone(id=1, start=home)  # type: ignore[arg-type]
        self.mission = Mission.model_validate(
            {"flight": flight, "drones": (drone,), "controller": {"planner": planner}}
        )
        self.homecoming = Homecoming(self.mission, 1, make_planner(self.mission, 1))
        self.body = VehicleBody.at(np.array([*place, 0.0, 1.3]))
        self.nearest_m = math.inf
        self.time_s = 0.0

    def fly(self, *, home: bool, limit_s: float = 90.0) -> None:
        flight, dt = self.mission.flight, self.mission.tick_s
        for tick in range(round(limit_s / dt)):
            decision = self.homecoming.steer(self.body.pose, self.body.velocity, [], home=home, now_s=tick * dt)
            assert decision.outcome == "solved"
            if self.homecoming.landing:
                self.time_s = tick * dt
                return
            self.body.command(decision.velocity, tick * dt, flight)
            self.body.step(dt, tick * dt, flight)
            if tick % 4 == 0:
                self.nearest_m = min(self.nearest_m, distance_m(flight, self.body.pose[:3]))
        raise AssertionError(f"still in the air at {self.body.pose}")


@pytest.mark.parametrize("seed", range(16))
def test_a_drone_gets_home_around_random_zones(seed: int) -> None:
    flight, rng = random_flight(seed)
    home, place = starts(flight, rng, 2)
    flown = Flown(flight, home, np.array(place[:3]))
    flown.fly(home=True)
    assert flown.nearest_m >= flight.clearance_m
    assert math.dist(flown.body.pose[:2], home[:2]) < 0.25
    assert flown.body.pose[2] < flight.lower_m[2] + 0.1


def test_who_is_to_land_above_a_table_lands_beside_it() -> None:
    flown = Flown(FLIGHT, (-3.0, 0.0, 2.0, 0.0, 1.3), np.array([-1.8, -1.9, 1.8]))
    flown.fly(home=False)
    assert flown.nearest_m >= FLIGHT.clearance_m
    assert flown.body.pose[2] < FLIGHT.lower_m[2] + 0.1
    xs, ys = zip(*TABLE["polygon"], strict=True)
    assert not (min(xs) < flown.body.pose[0] < max(xs) and min(ys) < flown.body.pose[1] < max(ys))


def test_where_no_way_leads_home_a_drone_lands_where_it_is_in_the_end() -> None:
    """Only a drone that was carried over the wall is there."""
    moved = {**WALL, "polygon": tuple((x + 1.0, y) for x, y in WALL["polygon"])}
    flight = Flight(no_fly=(moved,))  # type: ignore[arg-type]
    flown = Flown(flight, (-2.0, 0.0, 1.0, 0.0, 1.3), np.array([3.0, 0.0, 1.0]))
    flown.fly(home=True)
    assert flown.body.pose[0] > 1.2 + flight.clearance_m
    assert STUCK_S < flown.time_s < STUCK_S + 15.0
