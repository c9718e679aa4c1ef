"""The strict rows are the barrier functions' conditions, and braking satisfies them."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.barriers import (
    FIXED_ROWS,
    PITCH,
    REGION,
    Barriers,
    Neighbour,
    predicted_pose,
    top_speed,
    widened_separation,
)
from protocol.geometry import Floats
from protocol.mission import Controller, Drone, Flight, Mission

PITCH_GAIN, GAIN = 2.0, 3.0
AGE_S = 0.4


def mission(flight: Flight | None = None) -> Mission:
    return Mission(
        flight=flight or Flight(),
        controller=Controller(pitch_gain_per_s=PITCH_GAIN, separation_gain_per_s=GAIN),
        drones=(Drone(id=1, start=(0, 1, 2, 0, 1.3)),),
    )


FLIGHT = Flight()
BARRIERS = Barriers(mission())
LOW, HIGH = FLIGHT.pitch_limits_rad
NEIGHBOURS = (
    Neighbour(4, np.array([1.6, -0.3, 2.2]), 0.0),
    Neighbour(7, np.array([-1.0, 2.0, 1.0]), AGE_S, error_m=0.3),
)
reproducible = settings(max_examples=200, deadline=None, derandomize=True)
poses = st.tuples(
    st.floats(-4, 4), st.floats(-4, 4), st.floats(0.5, 5), st.floats(-math.pi, math.pi), st.floats(LOW, HIGH)
).map(np.array)


def strong(speed: float, response: float) -> dict[str, float]:
    """Accelerations that a mission may have at this speed and lag, with nothing to spare."""
    least = 1.001 * max(speed, 0.5) / (response or 1.0)
    return {"acceleration_max_mps2": least, "angular_acceleration_max_radps2": least}


def separation(neighbour: Neighbour) -> Callable[[Floats], float]:
    distance = widened_separation(FLIGHT, neighbour.error_m) + top_speed(FLIGHT) * neighbour.age_s
    return lambda pose: math.dist(pose[:3], neighbour.position) ** 2 - distance**2


def face(axis: int, sign: int) -> Callable[[Floats], float]:
    limit = FLIGHT.lower_m[axis] if sign > 0 else FLIGHT.upper_m[axis]
    return lambda pose: sign * (pose[axis] - limit)


FUNCTIONS: dict[str, Callable[[Floats], float]] = {
    PITCH: lambda pose: (pose[4] - LOW) * (HIGH - pose[4]),
    "region:-x": face(0, +1),
    "region:-y": face(1, +1),
    "region:-z": face(2, +1),
    "region:+x": face(0, -1),
    "region:+y": face(1, -1),
    "region:+z": face(2, -1),
    "separation:4": separation(NEIGHBOURS[0]),
    "separation:7": separation(NEIGHBOURS[1]),
}
"""Each barrier written down on its own, positive where it is safe."""


@reproducible
@given(pose=poses)
def test_each_row_says_that_its_barrier_may_fall_only_so_fast(pose: Floats) -> None:
    """Row: grad b . u >= -gain b, the gradient by finite differences."""
    rows = BARRIERS.rows(pose, NEIGHBOURS)

    assert rows.names == tuple(FUNCTIONS)
    for name, coefficients, bound, barrier in zip(
        rows.names, rows.coefficients, rows.bounds, rows.barriers, strict=True
    ):
        function, step = FUNCTIONS[name], 1e-6
        gradient = [(function(pose + step * axis) - function(pose - step * axis)) / (2 * step) for axis in np.eye(5)]
        assert barrier == pytest.approx(function(pose), abs=1e-9), name
        assert coefficients == pytest.approx(np.array(gradient), abs=1e-7), name
        assert bound == pytest.approx(-(PITCH_GAIN if name == PITCH else GAIN) * function(pose), abs=1e-9), name


def test_a_lone_drone_has_the_fixed_rows() -> None:
    rows = BARRIERS.rows(np.array([0, 0, 2, 0, 1.3]), [])

    assert rows.names == (PITCH, *REGION)
    assert len(rows.names) == FIXED_ROWS


@pytest.mark.parametrize(("pitch", "inward"), [(LOW, +1), (HIGH, -1)])
def test_at_either_pitch_limit_the_gimbal_may_only_turn_back(pitch: float, inward: int) -> None:
    rows = BARRIERS.rows(np.array([0, 0, 2, 0, pitch]), [])

    assert rows.barriers[0] == pytest.approx(0.0, abs=1e-12)
    assert rows.bounds[0] == pytest.approx(0.0, abs=1e-12)
    assert rows.coefficients[0, 4] * inward == pytest.approx(HIGH - LOW)
    assert not rows.coefficients[0, :4].any()


def test_beyond_a_pitch_limit_the_gimbal_must_turn_back() -> None:
    for pitch, inward in ((LOW - 0.1, +1), (HIGH + 0.1, -1)):
        rows = BARRIERS.rows(np.array([0, 0, 2, 0, pitch]), [])
        assert rows.barriers[0] < 0
        assert rows.bounds[0] / (rows.coefficients[0, 4] * inward) > 0


@reproducible
@given(separation_m=st.floats(0.1, 5), speed=st.floats(0.01, 20), response=st.just(0.0) | st.floats(0.001, 3))
def test_the_widened_separation_is_the_root_of_its_equation(separation_m: float, speed: float, response: float) -> None:
    """Also for a vehicle so fast or slow to respond that it travels many separations within its lag."""
    flight = Flight(separation_m=separation_m, speed_max_mps=speed, response_time_s=response, **strong(speed, response))

    wide = widened_separation(flight)

    turned = 2 * math.sqrt(3) * speed * response / wide
    assert wide / (1 + turned**2) == pytest.approx(separation_m, rel=1e-9)
    assert wide >= separation_m * (1 - 1e-12)


def test_without_a_lag_the_separation_is_that_of_the_mission() -> None:
    assert widened_separation(Flight(response_time_s=0.0, separation_m=1.25)) == 1.25


def test_what_estimates_may_be_off_counts_as_separation() -> None:
    told = widened_separation(FLIGHT, 0.4)
    assert told == widened_separation(FLIGHT.model_copy(update={"position_error_m": FLIGHT.position_error_m + 0.2}))
    assert told > widened_separation(FLIGHT) + 0.3


def test_the_prediction_is_where_a_lagging_vehicle_comes_to_rest() -> None:
    flight = Flight(response_time_s=0.2)
    pose, velocity = np.array([1.0, 2, 3, 0.5, 1.2]), np.array([0.5, -0.5, 0, 0.1, -0.1])

    assert predicted_pose(pose, velocity, flight) == pytest.approx(np.array([1.1, 1.9, 3, 0.52, 1.18]))


@reproducible
@given(pose=poses, age=st.floats(0, 60))
def test_a_silent_neighbour_grows_with_its_age_times_its_top_speed(pose: Floats, age: float) -> None:
    fresh, silent = (
        BARRIERS.rows(pose, [Neighbour(4, NEIGHBOURS[0].position, seconds)]).barriers[-1] for seconds in (0.0, age)
    )
    near, far = widened_separation(FLIGHT), widened_separation(FLIGHT) + math.sqrt(3) * FLIGHT.speed_max_mps * age

    assert fresh - silent == pytest.approx(far**2 - near**2, abs=1e-9)


neighbours = st.lists(
    st.builds(
        Neighbour,
        st.integers(2, 255),
        st.tuples(st.floats(-4, 4), st.floats(-4, 4), st.floats(0.5, 5)).map(np.array),
        st.floats(0, 5),
    ),
    max_size=5,
)


@reproducible
@given(pose=poses, others=neighbours)
def test_braking_satisfies_every_row_whose_barrier_is_not_negative(pose: Floats, others: list[Neighbour]) -> None:
    rows = BARRIERS.rows(pose, others)

    satisfied = rows.coefficients @ np.zeros(5) >= rows.bounds

    assert (satisfied == (rows.barriers >= 0)).all()
    assert satisfied[:FIXED_ROWS].all() or rows.barriers[:FIXED_ROWS].min() < 0


@reproducible
@given(
    pose=poses,
    others=neighbours,
    velocity=st.tuples(*[st.floats(-0.5, 0.5)] * 5).map(np.array),
)
def test_a_velocity_that_satisfies_the_rows_keeps_every_drone_barrier_for_a_whole_tick(
    pose: Floats, others: list[Neighbour], velocity: Floats
) -> None:
    """Region and separation, u held over one tick: b falls by at most gain x tick x b."""
    tick_s = mission().tick_s
    rows = BARRIERS.rows(pose, others)
    before = rows.barriers[1:]
    held = (rows.coefficients[1:] @ velocity >= rows.bounds[1:]) & (before >= 0)

    after = BARRIERS.rows(pose + tick_s * velocity, others).barriers[1:]

    assert (after[held] >= (1 - GAIN * tick_s) * before[held] - 1e-9).all()


def test_the_margin_of_a_kind_is_its_smallest_barrier() -> None:
    rows = BARRIERS.rows(np.array([3.5, 0, 2, 0, 1.3]), NEIGHBOURS)

    assert rows.margin("region", 9.0) == pytest.approx(0.5)
    assert rows.margin("separation", 9.0) == rows.barriers[FIXED_ROWS:].min()
    assert BARRIERS.rows(np.array([3.5, 0, 2, 0, 1.3]), []).margin("separation", 9.0) == 9.0


speeds = st.tuples(*[st.floats(-0.7, 0.7)] * 5).map(np.array)


@reproducible
@given(velocity=speeds, response=st.sampled_from([0.0, 0.05, 0.15, 1.0]))
def test_braking_is_always_within_the_velocity_bounds(velocity: Floats, response: float) -> None:
    flight = Flight(response_time_s=response, **strong(0.5, response))
    low, high = Barriers(mission(flight)).velocity_bounds(velocity)

    assert (low <= 0).all()
    assert (high >= 0).all()


@reproducible
@given(velocity=speeds)
def test_velocity_bounds_keep_within_the_input_box_and_the_acceleration(velocity: Floats) -> None:
    flight = Flight(response_time_s=0.05, acceleration_max_mps2=10.0, angular_acceleration_max_radps2=12.0)
    change = 0.05 * np.array([10, 10, 10, 12, 12])

    low, high = Barriers(mission(flight)).velocity_bounds(velocity)

    assert low.min() >= -0.5
    assert high.max() <= 0.5
    assert (low >= np.minimum(velocity - change, 0.0)).all()
    assert (high <= np.maximum(velocity + change, 0.0)).all()


def test_a_vehicle_without_lag_is_bounded_by_the_input_box_alone() -> None:
    low, high = Barriers(mission(Flight(response_time_s=0.0))).velocity_bounds(np.full(5, 0.5))

    assert low.tolist() == [-0.5] * 5
    assert high.tolist() == [0.5] * 5
