"""Where drones may be: distances, the words for places where they may not, and missions that are refused."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from faults.zones import L_SHAPE, PILLAR, TABLE, distance_m, l_shaped, random_flight
from protocol.airspace import airspace_of, outlines
from protocol.formation import formation
from protocol.free_space import free_space, start_fault
from protocol.mission import Drone, Flight, Mission
from protocol.mission_file import load_mission, mission_to_toml
from protocol.separation import top_speed, widened

FLIGHT = l_shaped()
OPEN = airspace_of(Flight())


@pytest.mark.parametrize("seed", range(12))
def test_the_smallest_barrier_is_the_distance_less_what_is_kept(seed: int) -> None:
    flight, rng = random_flight(seed)
    airspace = airspace_of(flight)
    points = rng.uniform(flight.lower_m, flight.upper_m, (40, 3))
    for point, margin in zip(points, airspace.margins(points), strict=True):
        distance = distance_m(flight, point)
        if distance <= 0:
            assert margin < 0
        else:  # the hull keeps d, all else D
            assert distance - airspace.wide_m - 0.01 < margin < distance - airspace.distance_m + 0.01
            assert margin == pytest.approx(airspace.barriers(point, 0.0).values_m.min(), abs=1e-12)


@pytest.mark.parametrize("seed", range(12))
def test_a_barrier_is_convex_and_its_gradient_its_slope(seed: int) -> None:
    """b(y + s) >= b(y) + grad b . s wherever b >= 0: a linear row over a whole tick never promises too much."""
    flight, rng = random_flight(seed)
    airspace = airspace_of(flight)
    checked = 0
    for point in rng.uniform(flight.lower_m, flight.upper_m, (60, 3)):
        here = airspace.barriers(point, math.inf)
        step = rng.normal(size=3) * rng.choice([1e-6, 0.05, 1.0])
        there = airspace.barriers(point + step, math.inf)
        safe = here.values_m >= 0
        assert np.linalg.norm(here.gradients, axis=1) == pytest.approx(np.ones(len(here.names)))
        assert (there.values_m >= here.values_m + here.gradients[:, :3] @ step - 1e-9)[safe].all()
        if np.linalg.norm(step) < 1e-4:
            assert there.values_m[safe] == pytest.approx((here.values_m + here.gradients[:, :3] @ step)[safe], abs=1e-9)
        checked += int(safe.sum())
    assert checked > 30


def test_what_is_kept_is_widened_by_what_lag_and_error_add() -> None:
    airspace = airspace_of(l_shaped(position_error_m=0.1))
    assert airspace.distance_m == pytest.approx(0.4)
    assert airspace.wide_m == widened(0.4, top_speed(FLIGHT) * FLIGHT.response_time_s)
    assert airspace_of(l_shaped(response_time_s=0.0)).wide_m == pytest.approx(0.3)


def test_a_mission_without_zones_is_open() -> None:
    assert OPEN.is_open
    assert OPEN.margins(np.zeros((2, 3))).tolist() == [math.inf, math.inf]
    assert OPEN.inside_m(np.zeros(3)) == 0.0
    assert OPEN.fault((9.0, 0.0, 0.0)) == ""
    assert outlines(Flight()).shape == (0, 2, 3)


@pytest.mark.parametrize(
    ("point", "fault"),
    [
        ((-3.0, 0.0, 2.0), ""),
        ((0.5, 0.5, 2.0), "lies outside the boundary; drones keep 0.34 m from it"),
        ((3.9, -2.0, 2.0), "lies 0.10 m from the boundary; drones keep 0.30 m from it"),
        ((1.0, -2.0, 2.0), "lies inside no-fly zone 'pillar'; drones keep 0.34 m from it"),
        ((-1.0, -2.0, 0.8), "lies 0.20 m from no-fly zone 'table'; drones keep 0.34 m from it"),
        ((-2.0, -2.0, 2.0), "lies above no-fly zone 'table': no drone could land there"),
    ],
)
def test_a_place_is_refused_with_the_zone_and_the_distance(point: tuple[float, ...], fault: str) -> None:
    assert airspace_of(FLIGHT).fault(point).startswith(fault)
    assert bool(airspace_of(FLIGHT).fault(point)) == bool(fault)


def test_how_far_inside_is_measured_from_where_the_clearance_begins() -> None:
    inside = airspace_of(FLIGHT).inside_m
    assert inside(np.array([-3.0, 0.0, 2.0])) == 0.0
    assert inside(np.array([-1.0, -2.0, 0.8])) == pytest.approx(0.1)
    assert inside(np.array([0.2, 2.0, 2.0])) == pytest.approx(0.5)
    assert inside(np.array([5.0, -2.0, 2.0])) == pytest.approx(1.3)


WALL = {"name": "wall", "polygon": ((-0.2, -4.0), (0.2, -4.0), (0.2, 4.0), (-0.2, 4.0))}


@pytest.mark.parametrize(
    ("settings", "fault"),
    [
        ({"boundary": ((0.0, 0.0), (1.0, 0.0))}, "has 2 corners, a polygon needs 3"),
        ({"boundary": ((-5.0, 0.0), (1.0, 0.0), (1.0, 1.0))}, "boundary: the corner [-5.0, 0.0] lies outside the box"),
        ({"no_fly": (TABLE, TABLE)}, "no_fly: names must differ, got ['table', 'table']"),
        ({"no_fly": ({**TABLE, "lower_m": 1.5},)}, "upper_m 1.2 must exceed lower_m 1.5"),
        ({"no_fly": ({**TABLE, "upper_m": 0.4},)}, "'table' lies below the box: it forbids nothing"),
        ({"no_fly": ({"name": "lamp", "polygon": TABLE["polygon"], "lower_m": 5.0},)}, "'lamp' lies above the box"),
        (
            {"no_fly": ({**TABLE, "polygon": ((5.0, 0.0), (6.0, 0.0), (5.0, 1.0))},)},
            "'table' lies outside the box along x",
        ),
        ({"no_fly": ({**TABLE, "polygon": ((0.0, 0.0), (1.0, 1.0), (1.0, 0.0), (0.0, 1.0))},)}, "crosses itself"),
        (
            {"boundary": ((0.0, 0.0), (0.5, 0.0), (0.0, 0.5))},
            "no_fly, boundary: nothing is left to fly in at 0.34 m from zones and boundary",
        ),
    ],
)
def test_zones_that_make_no_sense_are_refused(settings: dict[str, Any], fault: str) -> None:
    with pytest.raises(ValidationError) as refused:
        Flight(**settings)
    assert fault in str(refused.value)


def at(*start: float) -> tuple[Drone, ...]:
    return (Drone(id=3, start=(*start, 0.0, 1.3)),)  # type: ignore[arg-type]


def test_a_start_in_a_zone_or_outside_the_boundary_is_refused_with_the_drone() -> None:
    Mission(flight=FLIGHT, drones=at(-3.0, 0.0, 2.0))
    for start, words in (((1.0, -2.0, 2.0), "inside no-fly zone 'pillar'"), ((2.0, 2.0, 2.0), "outside the boundary")):
        with pytest.raises(ValidationError) as refused:
            Mission(flight=FLIGHT, drones=at(*start))
        assert f"drones.0.start: {list(start)} of drone 3 lies {words}" in str(refused.value)


def test_a_start_that_is_shut_in_is_refused_and_a_way_over_the_wall_lets_it_out() -> None:
    def share(**wall: Any) -> float:
        flight = Flight(no_fly=({**WALL, **wall},))  # type: ignore[arg-type]
        return free_space(flight).reached((-2.0, 0.0, 1.0))

    assert share() == pytest.approx(0.5, abs=0.01)
    assert share(upper_m=3.0) == 1.0
    assert share(lower_m=2.0) == 1.0
    assert share(upper_m=4.9) == pytest.approx(0.5, abs=0.02), "0.1 m under the ceiling is too little"
    moved = {**WALL, "polygon": tuple((x + 1.0, y) for x, y in WALL["polygon"])}
    assert start_fault(Flight(no_fly=(moved,)), (-2.0, 0.0, 1.0)) == ""  # type: ignore[arg-type]
    fault = start_fault(Flight(no_fly=(moved,)), (3.0, 0.0, 1.0))  # type: ignore[arg-type]
    assert fault == "is cut off: only 36% of where drones may fly can be reached from there"


def test_drones_that_the_file_does_not_place_start_outside_the_zones() -> None:
    starts = formation(FLIGHT, 5)
    assert len(starts) == 5
    for start in starts:
        assert distance_m(FLIGHT, np.array(start[:3])) >= 0.3
        assert not start_fault(FLIGHT, start)


def test_zones_are_written_and_read_with_the_mission(tmp_path: Path) -> None:
    mission = Mission(flight=FLIGHT, drones=at(-3.0, 0.0, 2.0))
    path = tmp_path / "zones.toml"
    path.write_text(mission_to_toml(mission))
    assert load_mission(path) == mission
    assert load_mission(path).flight.no_fly[1].name == PILLAR["name"]


def test_outlines_show_every_edge_between_the_box_s_heights() -> None:
    edges = outlines(FLIGHT)
    assert len(edges) == 3 * (len(L_SHAPE) + 4 + 3)
    assert edges[:, :, 2].min() == FLIGHT.lower_m[2]
    assert edges[:, :, 2].max() == FLIGHT.upper_m[2]
