"""Whoever is unsure of its place keeps farther from box, boundary and zones, so that it keeps what the mission says."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from agents.barriers import FIXED_ROWS, Barriers, Rows
from agents.homing import STUCK_S, TOUCHDOWN_M, Homecoming
from agents.planners.coverage import CoverageController
from agents.planners.safety_filter import SafetyFilter
from faults.zones import L_SHAPE, distance_m, l_shaped, random_flight
from protocol.airspace import airspace_of, airspace_within
from protocol.geometry import Floats
from protocol.mission import Drone, Flight, Mission
from protocol.separation import SIGMAS, error_beyond, top_speed, widened
from sim_bridge.dynamics import VehicleBody

TICK_S = 0.05
GIMBAL_RAD = 1.3
CORRIDOR_M = 0.9
PASSAGE = (
    {"name": "left", "polygon": ((-2.0, -1.0), (-CORRIDOR_M / 2, -1.0), (-CORRIDOR_M / 2, 1.0), (-2.0, 1.0))},
    {"name": "right", "polygon": ((CORRIDOR_M / 2, -1.0), (2.0, -1.0), (2.0, 1.0), (CORRIDOR_M / 2, 1.0))},
)
"""Through it leads the way along y, which a drone may fly that is sure of its place."""


def mission(flight: Flight, home: tuple[float, float, float] = (-3.0, 0.0, 2.0)) -> Mission:
    """The drone's start is anywhere: nobody takes off here."""
    start = Drone(id=1, start=(*home, 0.0, GIMBAL_RAD))
    return Mission.model_construct(**{**dict(Mission(drones=(start,))), "flight": flight, "drones": (start,)})


def rows_at(flight: Flight, place: tuple[float, float, float], deviation_m: float) -> Rows:
    barriers = Barriers(mission(flight))
    barriers.note_deviation(deviation_m)
    return barriers.rows(np.array([*place, 0.0, GIMBAL_RAD]), [])


def test_box_and_boundary_shrink_by_what_the_estimate_may_be_off_and_zones_grow_by_the_exact_root() -> None:
    flight = l_shaped(position_error_m=0.02)
    place, deviation = (-0.9, -1.9, 0.9), 0.05
    sure, unsure = rows_at(flight, place, 0.0), rows_at(flight, place, deviation)
    beyond = SIGMAS * deviation - 0.02
    wide = widened(0.3 + SIGMAS * deviation, top_speed(flight) * flight.response_time_s)

    assert sure.names[FIXED_ROWS] == "zone:table"
    assert unsure.barriers[1:FIXED_ROWS] == pytest.approx(sure.barriers[1:FIXED_ROWS] - beyond, abs=1e-12)
    assert unsure.barriers[FIXED_ROWS] == pytest.approx(0.3 - wide, abs=1e-12)
    assert unsure.bounds[FIXED_ROWS] == -unsure.barriers[FIXED_ROWS], "and demands to leave"
    assert unsure.barriers[0] == sure.barriers[0], "the gimbal's is not about a place"
    hull = rows_at(flight, (-3.0, 0.0, 2.0), deviation)
    assert hull.barriers[hull.of("zone")].min() == pytest.approx(1.0 - 0.3 - SIGMAS * deviation, abs=1e-12)


@pytest.mark.parametrize("deviation", [0.0, 0.01, 0.02])
def test_what_the_mission_counts_with_anyway_changes_no_bit(deviation: float) -> None:
    flight, rng = random_flight(1, position_error_m=0.06)
    told, untold = Barriers(mission(flight)), Barriers(mission(flight))
    told.note_deviation(0.1)
    told.note_deviation(deviation)
    for place in rng.uniform(flight.lower_m, flight.upper_m, (50, 3)):
        pose = np.array([*place, 0.0, GIMBAL_RAD])
        one, other = told.rows(pose, []), untold.rows(pose, [])
        assert one.names == other.names
        for name in ("coefficients", "bounds", "barriers"):
            assert getattr(one, name).tobytes() == getattr(other, name).tobytes()
    assert airspace_within(flight, deviation) is airspace_of(flight)


class Lone:
    """One drone that flies what it is told, where it believes to be; ``deviation_m`` is what it tells."""

    def __init__(self, flight: Flight, place: Floats, deviation_m: float = 0.0) -> None:
        self.flight, self.deviation_m = flight, deviation_m
        self.body = VehicleBody.at(np.array([*place, 0.0, GIMBAL_RAD]))
        self.filter = SafetyFilter(mission(flight), 0)
        self.outcomes: list[str] = []

    @property
    def place(self) -> Floats:
        return self.body.pose[:3]

    def pulled(self, pull: Floats) -> None:
        self.filter.note_deviation(self.deviation_m)
        decision = self.filter.solve(self.body.pose, self.body.velocity, [], pull, -1e4)
        self.outcomes.append(decision.outcome)
        self.flown(decision.velocity)

    def flown(self, velocity: Floats) -> None:
        self.body.command(velocity, 0.0, self.flight)
        self.body.step(TICK_S, 0.0, self.flight)

    def margin(self) -> float:
        """The smallest barrier of box, boundary and zones, with what is told now."""
        beyond = error_beyond(self.flight, self.deviation_m)
        box = min(*(self.place - self.flight.lower_m), *(self.flight.upper_m - self.place)) - beyond
        return min(box, float(airspace_within(self.flight, self.deviation_m).margins(self.place[None])[0]))


@pytest.mark.parametrize("seed", range(12))
def test_the_true_position_keeps_the_clearance_however_far_off_it_is_told_to_be(seed: int) -> None:
    """Off by three deviations, in the worst direction and in any, at every tick, while a planner pulls anywhere."""
    rng = np.random.default_rng(seed)
    deviation = float(rng.uniform(0.02, 0.15))
    flight, _ = random_flight(
        seed,
        clearance_m=float(rng.choice([0.1, 0.3])),
        position_error_m=float(rng.choice([0.0, 0.05])),
        response_time_s=float(rng.choice([0.0, 0.15, 0.25])),
        acceleration_max_mps2=1000.0,  # that the lag model is all there is
    )
    grown, beyond = airspace_within(flight, deviation), error_beyond(flight, deviation)
    off = beyond + flight.position_error_m
    assert off == pytest.approx(max(SIGMAS * deviation, flight.position_error_m))
    places = rng.uniform(np.array(flight.lower_m) + beyond, np.array(flight.upper_m) - beyond, (400, 3))
    places = places[grown.margins(places) >= 0]
    nearest = math.inf
    for place in places[:3]:
        drone, towards = Lone(flight, place, deviation), rng.normal(size=3)
        for tick in range(150):
            if tick % 30 == 0:
                pull = np.append(towards + 0.3 * rng.normal(size=3), rng.normal(size=2)) * 1e4
            drone.pulled(pull)
            towards = -grown.barriers(drone.place, 0.0).gradients[0, :3]
            for direction in (towards, rng.normal(size=3)):
                true = drone.place + off * direction / np.linalg.norm(direction)
                nearest = min(nearest, distance_m(flight, true))
                lower, upper = np.array(flight.lower_m), np.array(flight.upper_m)
                outside = max(*(lower - true), *(true - upper))
                assert outside <= flight.position_error_m + 1e-6, "of the box its centre leaves no more than that"
        assert drone.outcomes.count("solved") > 140
    assert nearest >= flight.clearance_m - 1e-6
    assert nearest < flight.clearance_m + 0.3, "and they fly up to it"


def test_a_drone_in_a_margin_that_grows_leaves_it_and_does_not_come_back() -> None:
    drone = Lone(l_shaped(), np.array([-3.0, -3.0, 3.0]))
    pull = np.array([-1e4, -1e4, 0.0, 0.0, 0.0])
    for _ in range(200):
        drone.pulled(pull)
    assert 0 <= drone.margin() < 0.02, "at the boundary's corner"

    drone.deviation_m = 0.1
    before = drone.margin()
    assert before == pytest.approx(-0.3, abs=0.02)
    for _ in range(120):
        drone.pulled(pull)
        assert drone.margin() >= before - 1e-9
        before = drone.margin()

    assert before > -0.01, "exponentially: after six seconds e^-6 of it is left"
    assert set(drone.outcomes) == {"solved"}


def test_a_margin_that_grows_steadily_is_short_of_what_a_second_and_the_lag_add_at_the_most() -> None:
    """b' >= -a b - D' on the predicted position: with a = 1 a second, b never falls below minus the growth of one."""
    flight, per_s = l_shaped(), 0.02
    drone = Lone(flight, np.array([-3.3, -3.3, 3.0]))
    shortest = math.inf
    for tick in range(200):
        drone.deviation_m = tick * TICK_S * per_s
        drone.pulled(np.array([-1e4, -1e4, 0.0, 0.0, 0.0]))
        shortest = min(shortest, drone.margin())
    assert -SIGMAS * per_s * (1 + flight.response_time_s) < shortest < -0.5 * SIGMAS * per_s


def corridor() -> Flight:
    return Flight(no_fly=PASSAGE)  # type: ignore[arg-type]


def test_between_two_zones_that_both_demand_to_leave_a_drone_brakes_until_it_knows_better() -> None:
    drone = Lone(corridor(), np.array([0.0, 0.0, 2.0]))
    along = np.array([0.0, 1e4, 0.0, 0.0, 0.0])
    drone.pulled(along)
    assert drone.outcomes == ["solved"]

    drone.deviation_m, place = 0.1, drone.place.copy()
    for _ in range(100):
        drone.pulled(along)
    assert "solved" not in drone.outcomes[1:], "no velocity meets both rows, and none is relaxed"
    assert math.dist(drone.place, place) < 0.1, "it stands"

    drone.deviation_m = 0.01
    for _ in range(100):
        drone.pulled(along)
    assert set(drone.outcomes[101:]) == {"solved"}
    assert drone.place[1] > 1.0


def brought_home(
    flight: Flight, start: tuple[float, float, float], home: tuple[float, float, float], deviation_m: float
) -> tuple[Lone, float, float]:
    """The drone when it is told to land, after how many seconds, and its smallest distance from a zone until then."""
    drone, team = Lone(flight, np.array(start), deviation_m), mission(flight, home)
    planner = CoverageController(team, 0)
    homecoming, nearest = Homecoming(team, 1, planner), math.inf
    planner.note_deviation(deviation_m)
    for tick in range(2000):
        decision = homecoming.steer(
            drone.body.pose,
            drone.body.velocity,
            [],
            home=True,
            now_s=tick * TICK_S,
            deviation_m=deviation_m,
        )
        if homecoming.landing:
            return drone, tick * TICK_S, nearest
        drone.flown(decision.velocity)
        nearest = min(nearest, distance_m(flight, drone.place))
    raise AssertionError(f"still in the air at {drone.place}")


WALL = {"name": "wall", "polygon": ((-0.6, -4.0), (0.6, -4.0), (0.6, 1.0), (-0.6, 1.0))}


@pytest.mark.parametrize("around", [{"boundary": L_SHAPE}, {"no_fly": (WALL,)}])
def test_who_is_unsure_comes_home_around_the_same_corners_but_farther_from_them(around: dict[str, Any]) -> None:
    flight, start, home = Flight(**around), (-2.2, -2.0 if "no_fly" in around else 3.0, 2.0), (2.6, -2.0, 2.0)
    _, sure_s, _ = brought_home(flight, start, home, 0.0)
    for deviation in (0.03, 0.1, 0.19):
        drone, took_s, nearest = brought_home(flight, start, home, deviation)
        assert math.dist(drone.place[:2], home[:2]) < 0.25
        assert took_s < sure_s + 0.4 * STUCK_S, "without having waited for anything"
        assert nearest >= flight.clearance_m + SIGMAS * deviation - 1e-6
        assert 0 < drone.place[2] - flight.lower_m[2] - SIGMAS * deviation < TOUCHDOWN_M


@pytest.mark.parametrize("start", [(0.0, 0.0, 2.0), (0.0, 1.8, 2.0)])
def test_a_return_whose_passage_has_closed_ends_on_the_ground_and_not_in_the_air(
    start: tuple[float, float, float],
) -> None:
    """In the passage, and before it: ways are looked for with the mission's own margins."""
    walls = tuple(
        {**zone, "polygon": tuple((math.copysign(4.0, x) if abs(x) > 1 else x, y) for x, y in zone["polygon"])}
        for zone in PASSAGE
    )
    flight = Flight(no_fly=walls)  # type: ignore[arg-type]
    open_drone, _, _ = brought_home(flight, start, (0.0, -2.0, 2.0), 0.0)
    assert math.dist(open_drone.place[:2], (0.0, -2.0)) < 0.25

    drone, took_s, nearest = brought_home(flight, start, (0.0, -2.0, 2.0), 0.1)

    assert STUCK_S < took_s < STUCK_S + 15.0
    assert drone.place[1] > -0.1, "on this side"
    assert nearest >= flight.clearance_m
