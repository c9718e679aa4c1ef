"""Rows of zones: exact, enough for a whole tick, never without an answer, and a way out of a zone that was entered."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from agents.barriers import FIXED_ROWS, Barriers, Neighbour, Rows
from agents.planners.safety_filter import ZONE_ROWS, SafetyFilter
from agents.policies import outside_m
from agents.quadratic_program import TOLERANCE
from faults.zones import TABLE, l_shaped, random_flight
from ground_station.console.constraints import all_in_words
from protocol.airspace import airspace_of
from protocol.geometry import Floats
from protocol.mission import Drone, Flight, Mission
from protocol.separation import widened_separation

TICK_S = 0.05


def mission(flight: Flight) -> Mission:
    """The drone's start is anywhere: nobody takes off here."""
    start = Drone(id=1, start=(-3.0, 0.0, 2.0, 0.0, 1.3))
    return Mission.model_construct(**{**dict(Mission(drones=(start,))), "flight": flight})


def safe_poses(flight: Flight, rng: np.random.Generator, count: int) -> Floats:
    """Where every barrier of box and zones is not negative, half of them where one nearly is."""
    places = rng.uniform(flight.lower_m, flight.upper_m, (30 * count, 3))
    margins = airspace_of(flight).margins(places)
    places, margins = places[margins >= 0], margins[margins >= 0]
    nearest = places[np.argsort(margins)]
    chosen = np.concatenate([nearest[: count // 2], places[: count - count // 2]])
    return np.column_stack([chosen, np.zeros(len(chosen)), np.full(len(chosen), 1.3)])


def neighbours(flight: Flight, pose: Floats, rng: np.random.Generator) -> list[Neighbour]:
    """As near as they may be, all around."""
    found = []
    for drone in range(2, 2 + int(rng.integers(0, 5))):
        direction = rng.normal(size=3)
        distance = widened_separation(flight) + float(rng.choice([0.0, 1e-4, 0.3]))
        found.append(Neighbour(drone, pose[:3] + direction / np.linalg.norm(direction) * distance, 0.0))
    return found


def test_zone_rows_come_last_and_only_where_they_can_be_a_limit() -> None:
    flight = l_shaped()
    barriers = Barriers(mission(flight))
    other = Neighbour(4, np.array([-3.0, 3.0, 2.0]), 0.0)

    near = barriers.rows(np.array([-0.5, -1.9, 0.9, 0.0, 1.3]), [other])
    far = barriers.rows(np.array([-2.7, 1.0, 3.0, 0.0, 1.3]), [other])

    assert near.names[FIXED_ROWS:] == ("separation:4", "zone:table", "zone:pillar")
    assert near.barriers[-2:] == pytest.approx([0.7 - airspace_of(flight).wide_m, 1.1 * 0.98 - 0.343], abs=0.1)
    assert (near.bounds[-2:] == -near.barriers[-2:]).all()
    assert far.names[FIXED_ROWS + 1 :] == ("zone:boundary",), "the nearest of all, for the margin that is told"
    assert near.margin("zone", 9.0) == near.barriers[-2:].min()
    assert near.margin("separation", 9.0) > 5, "which is not a zone's"
    assert all_in_words(near.names[-2:]) == "no-fly zone 'table', no-fly zone 'pillar'"
    assert all_in_words(far.names[-1:]) == "the boundary"


def test_a_zone_that_is_left_out_is_no_limit_even_at_top_speed() -> None:
    flight = l_shaped()
    some = Barriers(mission(flight))
    everything = airspace_of(flight)
    gain, speed = 1.0, math.sqrt(3) * flight.speed_max_mps
    for pose in safe_poses(flight, np.random.default_rng(3), 100):
        kept = some.rows(pose, [])
        found = everything.barriers(pose[:3], math.inf)
        left_out = found.values_m > max(speed / gain, found.values_m.min())
        assert len(kept.names) == FIXED_ROWS + int((~left_out).sum())
        assert (-speed >= -gain * found.values_m[left_out]).all()


@pytest.mark.parametrize("seed", range(15))
def test_rows_always_have_an_answer_and_the_answer_keeps_every_barrier_for_a_tick(seed: int) -> None:
    """Zones, box, gimbal and neighbours at once, each barrier as small as 0, and a planner that pulls anywhere.

    The solver's rows are tighter by its tolerance. So who is held from all sides with barriers below that may get none
    from it, and brakes: the answer all the same.
    """
    flight, rng = random_flight(seed)
    team = mission(flight)
    chosen, barriers = SafetyFilter(team, 4), Barriers(team)
    for pose in safe_poses(flight, rng, 20):
        others = neighbours(flight, pose, rng)
        rows = barriers.rows(pose, others)
        assert (rows.bounds <= 1e-9).all(), "u = 0 meets every row"

        decision = chosen.solve(pose, np.zeros(5), others, rng.normal(size=5) * 1e4, -1e4)

        assert decision.outcome == "solved" or _is_held(rows, decision.velocity)
        after = barriers.rows(pose + TICK_S * decision.velocity, others)
        zones, zones_after = rows.of("zone"), after.of("zone")
        assert after.barriers[1:FIXED_ROWS].min() >= -1e-9
        assert after.barriers[zones_after].min() >= (1 - TICK_S) * min(rows.barriers[zones].min(), 1.0) - 1e-9


def _is_held(rows: Rows, velocity: Floats) -> bool:
    tight = rows.coefficients[rows.barriers < 2 * TOLERANCE]
    return not velocity.any() and len(tight) > 1


def test_more_zones_at_once_than_there_is_room_for_make_room() -> None:
    stones = tuple(
        {"name": f"stone {k}", "polygon": ((x, y), (x + 0.1, y), (x, y + 0.1))}
        for k, (x, y) in enumerate(itertools.product([-0.6, -0.1, 0.5], repeat=2))
        if (x, y) != (-0.1, -0.1)
    )
    team = mission(Flight(no_fly=stones, clearance_m=0.1))  # type: ignore[arg-type]
    decision = SafetyFilter(team, 0).solve(np.array([0.0, 0.0, 2.0, 0.0, 1.3]), np.zeros(5), [], np.ones(5), -1.0)
    assert len(decision.rows.of("zone")) == 8 > ZONE_ROWS
    assert decision.outcome == "solved"


@pytest.mark.parametrize("seed", range(8))
def test_braking_in_a_zone_backs_out_and_worsens_nothing(seed: int) -> None:
    flight, rng = random_flight(seed)
    chosen, barriers = SafetyFilter(mission(flight), 0), Barriers(mission(flight))
    low, high = barriers.velocity_bounds(np.zeros(5))
    broken = moved = 0
    for place in rng.uniform(flight.lower_m, flight.upper_m, (300, 3)):
        pose = np.array([*place, 0.0, 1.3])
        rows = barriers.rows(pose, [])
        zones = rows.of("zone")
        if rows.barriers[zones].min() >= 0:
            continue
        velocity = chosen.brake(rows, low, high)
        growth = rows.coefficients @ velocity
        assert (growth >= np.minimum(rows.bounds, 0.0) - 1e-12).all()
        broken += 1
        moved += bool(chosen.steer(pose, np.zeros(5), []).velocity.any())
    assert broken > 5
    assert moved >= 0.8 * broken, "where zones overlap, all ways out of one may lead into another"


def test_a_drone_that_was_blown_into_a_zone_leaves_it_by_the_next_side() -> None:
    team = mission(l_shaped())
    chosen, barriers = SafetyFilter(team, 0), Barriers(team)
    pose = np.array([-1.3, -1.9, 0.6, 0.0, 1.3])
    assert outside_m(team.flight, pose[:3].tolist()) == pytest.approx(0.4)
    assert barriers.rows(pose, []).margin("zone", 9.0) == pytest.approx(-0.1 - airspace_of(team.flight).wide_m)
    for _ in range(60):
        decision = chosen.steer(pose, np.zeros(5), [])
        pose = pose + TICK_S * decision.velocity
    assert pose[0] > TABLE["polygon"][1][0]
    assert pose[1] == pytest.approx(-1.9, abs=0.05)
    assert outside_m(team.flight, pose[:3].tolist()) == 0.0


def test_the_policies_see_how_far_a_drone_is_inside_a_zone_or_the_box_s_outside() -> None:
    flight = l_shaped()
    assert outside_m(flight, (-3.0, 0.0, 2.0)) == 0.0
    assert outside_m(flight, (-3.0, 0.0, 5.7)) == pytest.approx(0.7)
    assert outside_m(flight, (1.0, 2.0, 2.0)) == pytest.approx(1.3)
