"""Speed and acceleration that cost something, jerk that is bounded, and neither at the price of a strict row."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from agents.barriers import FIXED_ROWS, Barriers, Neighbour, Rows, widened_separation
from agents.planners.coverage import CoverageController
from agents.planners.safety_filter import SafetyFilter
from agents.quadratic_program import SMOOTH, QuadraticProgram, Smoothing
from faults.team_flight import TeamFlight
from protocol.geometry import Floats
from protocol.importance import SamplingTerms
from protocol.mission import Controller, Drone, Flight, Mission
from protocol.traffic import keyframe_rate_hz

LONE = (Drone(id=1, start=(0, 1, 2, 0, 1.3)),)
PAIR = (Drone(id=1, start=(-0.75, 0.4, 2, 0.5, 1.3)), Drone(id=2, start=(0.75, -0.2, 2, 2.0, 1.3)))
JERKY = Flight(jerk_max_mps3=6.0, angular_jerk_max_radps3=8.0)
CHANGE = np.array([6.0, 6.0, 6.0, 8.0, 8.0]) * 0.15 * 0.05
"""Of a command, tick by tick, as `JERKY` allows: jerk x lag x tick."""
ROOM = FIXED_ROWS + 4
BARRIERS = Barriers(Mission(drones=LONE))
MIDDLE = np.array([0, 0, 2, 0, 1.31])
reproducible = settings(max_examples=150, deadline=None, derandomize=True)

poses = st.tuples(
    st.floats(-4, 4), st.floats(-4, 4), st.floats(0.5, 5), st.floats(-math.pi, math.pi), st.floats(1.05, 1.57)
).map(np.array)
velocities = st.tuples(*[st.floats(-0.5, 0.5)] * 5).map(np.array)
wishes = st.tuples(*[st.floats(-300, 300)] * 5).map(np.array)
offsets = st.lists(st.tuples(*[st.floats(-2, 2)] * 3).map(np.array), max_size=4)


def others(pose: Floats, chosen: list[Floats]) -> list[Neighbour]:
    return [Neighbour(k, pose[:3] + offset, 0.0) for k, offset in enumerate(chosen, start=2)]


def is_safe(rows: Rows) -> bool:
    """So clearly that standing still is a solution, also to the solver's residual."""
    return bool((-rows.bounds > 1e-4 * np.maximum(np.linalg.norm(rows.coefficients, axis=1), 1e-3)).all())


# --- what speed and acceleration cost --------------------------------------------------------------------------------


def free(xi2: float, smoothing: float, flown: Floats) -> Floats:
    found = QuadraticProgram(ROOM, 0.01, SMOOTH).solve(
        np.full(5, 100.0),
        xi2,
        BARRIERS.rows(MIDDLE, []),
        np.full(5, -0.5),
        np.full(5, 0.5),
        smoothing=Smoothing(smoothing, flown),
    )
    assert found.outcome == "solved"
    return found.velocity


def test_the_velocity_minimises_what_is_said() -> None:
    """Far from what bounds it, where the cost's gradient is zero: 2 w xi1 / (|xi2| s) + 2 s (2 u - v) = 0."""
    flown = np.array([0.1, -0.2, 0.05, 0.15, -0.1])
    weight, xi2 = 20.0, -700.0
    reach = 5 * 100 * 0.5

    found = free(xi2, weight, flown)

    lack = 100.0 * found.sum() + xi2
    gradient = 2 * lack * 100.0 / (reach * abs(xi2)) + 2 * weight * (2 * found - flown)
    assert gradient == pytest.approx(np.zeros(5), abs=1e-2)
    assert np.abs(found).max() < 0.4


@pytest.mark.parametrize("xi2", [-10.0, -1e3, -1e6, -1e9])
def test_the_heavier_it_weighs_the_nearer_to_half_of_what_is_flown(xi2: float) -> None:
    flown = np.array([-0.4, 0.4, -0.2, 0.2, -0.4])
    gaps = [float(np.linalg.norm(free(xi2, weight, flown) - flown / 2)) for weight in (0.02, 0.2, 2.0, 200.0)]
    assert gaps == sorted(gaps, reverse=True)
    assert gaps[-1] < 0.01 < gaps[0]


@reproducible
@given(pose=poses, flown=velocities, xi1=wishes, xi2=st.floats(-1e6, 1e3), chosen=offsets)
def test_smooth_programs_are_solved_within_the_strict_rows_wherever_standing_still_is_allowed(
    pose: Floats, flown: Floats, xi1: Floats, xi2: float, chosen: list[Floats]
) -> None:
    rows = BARRIERS.rows(pose, others(pose, chosen))
    low, high = BARRIERS.velocity_bounds(flown)

    found = QuadraticProgram(ROOM, 0.01, SMOOTH).solve(xi1, xi2, rows, low, high, smoothing=Smoothing(0.15, flown))

    if is_safe(rows):
        assert found.outcome == "solved"
    if found.outcome == "solved":
        assert (rows.coefficients @ found.velocity >= rows.bounds - 1e-9).all()
        assert (found.velocity >= low).all()
        assert (found.velocity <= high).all()


def test_a_pitch_row_beside_the_bound_of_the_pitch_rate_does_not_stop_the_solver() -> None:
    """Of a flight: the row says 0.4981, the bound 0.5, and the solver went to and fro between them for 16 s."""
    low, high = Flight().pitch_limits_rad
    program = QuadraticProgram(ROOM, 0.01, SMOOTH)
    outcomes = []
    for away in np.linspace(-0.12, 0.12, 241):
        rows = BARRIERS.rows(np.array([-0.5, 0.2, 2, 0, (low + high) / 2 + away]), [])
        for side in (-1.0, 1.0):
            xi1 = np.array([-38.0, 57, 29, 19, side * 414])
            flown = np.array([0.36, 0.4, -0.05, 0.01, 0.36])
            solution = program.solve(
                xi1, -920.0, rows, np.full(5, -0.5), np.full(5, 0.5), smoothing=Smoothing(0.5, flown)
            )
            outcomes.append(solution.outcome)
    assert set(outcomes) == {"solved"}


def test_rows_that_cannot_hold_together_are_told_with_smoothing_too() -> None:
    rows = BARRIERS.rows(np.array([9.0, 0, 2, 0, 1.31]), [])  # 5 m outside: 5 m/s are asked for, 0.5 allowed
    found = QuadraticProgram(ROOM, 0.01, SMOOTH).solve(
        np.ones(5), -1.0, rows, np.full(5, -0.5), np.full(5, 0.5), smoothing=Smoothing(0.1, np.zeros(5))
    )
    assert found.outcome == "infeasible"


def turns(flight: TeamFlight, seconds: float) -> tuple[int, float]:
    """Changes of direction beyond 0.05 m/s, and mean acceleration."""
    flown = []
    while flight.tick * flight.mission.tick_s < seconds:
        flight.step()
        flown.append([body.velocity for body in flight.bodies])
    speeds = np.array(flown)[..., :3].reshape(len(flown), -1)
    changes = sum(np.count_nonzero(np.diff(np.sign(axis[np.abs(axis) > 0.05]))) for axis in speeds.T)
    return changes, float(np.abs(np.diff(speeds, axis=0)).mean() / flight.mission.tick_s)


def test_a_smooth_team_turns_about_less_often_accelerates_less_and_sees_as_much() -> None:
    plain, smooth = (TeamFlight(Mission(drones=PAIR, controller=Controller(smoothing=s))) for s in (0.0, 0.1))
    (flips, acceleration), (fewer, less) = turns(plain, 60), turns(smooth, 60)
    assert fewer < 0.9 * flips
    assert less < 0.8 * acceleration
    assert smooth.outcomes.count("out_of_time") == 0
    assert smooth.path_m < plain.path_m
    assert smooth.importance < 1.15 * plain.importance
    assert smooth.min_separation >= 1.0


def test_smoothing_is_of_the_coverage_planner_alone() -> None:
    with pytest.raises(ValidationError, match=r'controller\.smoothing: planner "lawnmower" has none'):
        Mission(drones=LONE, controller=Controller(planner="lawnmower", smoothing=0.1))


def test_giving_way_and_flying_home_are_as_without_smoothing() -> None:
    plain, smooth = (
        CoverageController(Mission(drones=PAIR, controller=Controller(smoothing=s)), 1) for s in (0.0, 0.5)
    )
    near = [Neighbour(2, np.array([1.4, 0, 2]), 0.0)]
    wish = np.array([0.3, -0.2, 0.1, 0.0, 0.1])
    velocity = np.array([-0.4, 0.1, 0.0, 0.2, 0.0])
    asked = (MIDDLE, velocity, near, wish)
    assert plain.steer(*asked).velocity.tolist() == smooth.steer(*asked).velocity.tolist()
    terms = SamplingTerms(np.array([90.0, 40, 0, 0, 10]), 3.0, 5.0)
    flown = [planner.decide(MIDDLE, velocity, near, terms, 1e4).velocity for planner in (plain, smooth)]
    assert not np.allclose(*flown, atol=0.05)


# --- jerk ------------------------------------------------------------------------------------------------------------


@reproducible
@given(pose=poses, flown=velocities, before=velocities, xi1=wishes, chosen=offsets)
def test_a_bounded_jerk_never_takes_a_way_out_and_is_kept_unless_the_slowest_velocity_breaks_a_row(
    pose: Floats, flown: Floats, before: Floats, xi1: Floats, chosen: list[Floats]
) -> None:
    barriers = Barriers(Mission(drones=LONE, flight=JERKY))
    rows = barriers.rows(pose, others(pose, chosen))
    low, high = barriers.velocity_bounds(flown)

    near_low, near_high = barriers.gentle_bounds(before, rows, low, high)

    gentle = (near_high - near_low <= 2 * CHANGE + 1e-12).all()
    slowest = np.clip(0.0, before - CHANGE, before + CHANGE)
    if gentle:
        assert (np.abs(np.clip(before, near_low, near_high) - before) <= CHANGE + 1e-12).all()
        assert (near_low >= low).all()
        assert (near_high <= high).all()
        solution = QuadraticProgram(ROOM, 0.01).solve(xi1, -100.0, rows, near_low, near_high)
        assert solution.outcome == "solved"
        assert (np.abs(solution.velocity - before) <= CHANGE + 1e-9).all()
    else:
        assert (near_low <= 0).all(), "braking is allowed at once"
        assert (near_high >= 0).all()
        within = (slowest >= low).all() and (slowest <= high).all()
        margin = rows.coefficients @ slowest - rows.bounds
        assert not within or (margin < 1e-4 * np.linalg.norm(rows.coefficients, axis=1)).any()


def test_commands_change_by_no_more_than_the_jerk_allows_and_a_team_still_covers() -> None:
    mission = Mission(drones=PAIR, flight=JERKY)
    flight = TeamFlight(mission)
    commands = []
    for _ in range(400):
        flight.step()
        commands.append([body.commanded for body in flight.bodies])
    changes = np.abs(np.diff(np.array(commands), axis=0)) / CHANGE
    assert (changes <= 1 + 1e-6).all(axis=2).mean() > 0.9
    assert flight.min_separation >= 1.0
    assert flight.importance < 0.9


def test_somebody_who_comes_near_is_given_way_to_at_once() -> None:
    """With 0.045 m/s a tick it would take eleven ticks to stop."""
    safety = SafetyFilter(Mission(drones=LONE, flight=JERKY), 1)
    ahead = np.array([0.5, 0, 0, 0, 0])
    for _ in range(20):
        fast = safety.steer(MIDDLE, ahead, [], ahead).velocity
    assert fast[0] == pytest.approx(0.5, abs=0.01)

    near = Neighbour(2, MIDDLE[:3] + np.array([widened_separation(JERKY) + 0.15 * 0.5 + 0.001, 0, 0]), 0.0)
    given_way = safety.steer(MIDDLE, ahead, [near], ahead)

    assert given_way.outcome == "solved"
    assert given_way.velocity[0] < 0.01


def test_a_jerk_without_a_lag_is_refused() -> None:
    with pytest.raises(ValidationError, match="jerk_max_mps3 needs response_time_s"):
        Flight(response_time_s=0.0, jerk_max_mps3=1.0)


# --- gimbal ----------------------------------------------------------------------------------------------------------


def test_the_gimbal_turns_as_fast_as_the_vehicle_unless_it_is_said_otherwise() -> None:
    assert Flight(turn_rate_max_radps=0.4).velocity_limits[3:] == (0.4, 0.4)
    slow = Flight(gimbal_rate_max_radps=0.2)
    assert slow.velocity_limits == (0.5, 0.5, 0.5, 0.5, 0.2)
    low, high = Barriers(Mission(drones=LONE, flight=slow)).velocity_bounds(np.zeros(5))
    assert (low[4], high[4]) == (-0.2, 0.2)
    with pytest.raises(ValidationError, match="must be at least gimbal_rate_max_radps"):
        Flight(gimbal_rate_max_radps=2.0)
    fast = Flight(gimbal_rate_max_radps=1.0, angular_acceleration_max_radps2=8.0)
    plain, hurried = (Mission(drones=LONE, flight=f) for f in (Flight(), fast))
    assert keyframe_rate_hz(hurried) >= keyframe_rate_hz(plain)
