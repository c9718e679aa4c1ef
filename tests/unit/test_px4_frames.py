"""ENU and NED, one world for several local frames, and angles that wrap."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.vehicles.px4 import frames
from agents.vehicles.px4.frames import GlobalPosition, LocalFrame
from agents.vehicles.px4.setpoint import AngleSetpoint, yaw_setpoint
from protocol.geometry import camera_rotation, optical_axis
from sim_bridge.px4_endpoint.frames import unproject

ANGLES = st.floats(-20.0, 20.0)
TILTS = st.floats(-0.6, 0.6)
METRES = st.floats(-500.0, 500.0)
VECTORS = st.tuples(METRES, METRES, METRES).map(np.array)
ORIGINS = st.builds(GlobalPosition, st.floats(-80.0, 80.0), st.floats(-180.0, 180.0), st.floats(-100.0, 4000.0))


@given(ANGLES)
def test_a_wrapped_angle_is_the_same_angle_in_half_a_turn_either_way(angle: float) -> None:
    wrapped = frames.wrap(angle)

    assert -math.pi <= wrapped < math.pi
    assert math.cos(wrapped - angle) == pytest.approx(1.0)


@pytest.mark.parametrize(("ned_deg", "world_deg"), [(0, 90), (90, 0), (180, -90), (-90, -180), (-179, -91), (179, -89)])
def test_north_is_a_quarter_turn_from_east_and_clockwise_becomes_counter_clockwise(
    ned_deg: int, world_deg: int
) -> None:
    assert math.degrees(frames.world_yaw(math.radians(ned_deg))) == pytest.approx(world_deg)


@given(ANGLES)
def test_a_yaw_comes_back_the_way_it_went(angle: float) -> None:
    assert math.cos(frames.ned_yaw(frames.world_yaw(angle)) - angle) == pytest.approx(1.0)


def test_a_vector_keeps_its_meaning() -> None:
    assert frames.ned_vector(np.array([1.0, 2.0, 3.0])).tolist() == [2.0, 1.0, -3.0]


@given(VECTORS, VECTORS)
def test_a_place_comes_back_from_the_local_frame(origin: np.ndarray, place: np.ndarray) -> None:
    frame = LocalFrame(origin)

    assert frame.to_world(frame.to_local(place)) == pytest.approx(place, abs=1e-9)
    assert frame.to_world(np.zeros(3)) == pytest.approx(origin)


@given(ORIGINS, VECTORS)
def test_a_local_frame_is_found_where_the_vehicle_says_it_lies(origin: GlobalPosition, place: np.ndarray) -> None:
    latitude, longitude, altitude = unproject(
        (origin.latitude_deg, origin.longitude_deg, origin.altitude_m), tuple(frames.ned_vector(place).tolist())
    )

    found = frames.offset(origin, GlobalPosition(latitude, longitude, altitude))

    assert found == pytest.approx(place, abs=1e-4)


@given(ORIGINS)
def test_the_worlds_own_origin_lies_at_zero(origin: GlobalPosition) -> None:
    assert frames.offset(origin, origin).tolist() == [0.0, 0.0, 0.0]


def test_two_vehicles_with_origins_of_their_own_name_one_place_alike() -> None:
    world = GlobalPosition(47.0, 8.0, 400.0)
    places = [np.array([3.0, -4.0, 0.5]), np.array([-60.0, 80.0, -2.0])]
    meeting = np.array([10.0, 20.0, 3.0])
    told = []
    for place in places:
        there = unproject((47.0, 8.0, 400.0), tuple(frames.ned_vector(place).tolist()))
        seen_from_there = frames.ned_vector(meeting - place)  # what the vehicle measures
        told.append(LocalFrame(frames.offset(world, GlobalPosition(*there))).to_world(seen_from_there))

    assert told[0] == pytest.approx(meeting, abs=1e-3)
    assert told[0] == pytest.approx(told[1], abs=1e-3)


@given(ANGLES, st.floats(-1.5, 1.5))
def test_level_a_fixed_camera_looks_as_its_pose_says(heading: float, depression: float) -> None:
    fixed = frames.fixed_camera_rotation(0.0, 0.0, heading, depression)

    assert fixed == pytest.approx(camera_rotation(frames.world_yaw(heading), depression), abs=1e-9)


@given(TILTS, TILTS, ANGLES, st.floats(0.0, 1.5))
def test_a_tilted_camera_has_a_proper_rotation(roll: float, pitch: float, heading: float, depression: float) -> None:
    fixed = frames.fixed_camera_rotation(roll, pitch, heading, depression)

    assert fixed @ fixed.T == pytest.approx(np.eye(3), abs=1e-9)
    assert np.linalg.det(fixed) == pytest.approx(1.0)


@given(TILTS, ANGLES)
def test_a_nose_that_rises_lifts_the_camera(pitch: float, heading: float) -> None:
    forward = frames.fixed_camera_rotation(0.0, pitch, heading, 0.8)[:, 2]

    assert forward == pytest.approx(optical_axis(frames.world_yaw(heading), 0.8 - pitch), abs=1e-9)


def test_a_right_side_that_sinks_tilts_the_image() -> None:
    right = frames.fixed_camera_rotation(0.3, 0.0, 0.0, 0.0)[:, 0]

    assert right == pytest.approx([math.cos(0.3), 0.0, -math.sin(0.3)]), "heading north, the right side is east"


@given(TILTS, TILTS, ANGLES, st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_the_turn_rate_is_the_derivative_of_the_yaw(roll: float, pitch: float, yaw: float, q: float, r: float) -> None:
    step_s = 1e-6
    before = frames.body_rotation(roll, pitch, yaw)
    spin = np.array([[0.0, -r, q], [r, 0.0, 0.0], [-q, 0.0, 0.0]])
    after = before @ (np.eye(3) + step_s * spin)
    turned = frames.wrap(math.atan2(after[1, 0], after[0, 0]) - math.atan2(before[1, 0], before[0, 0]))

    assert frames.turn_rate(roll, pitch, q, r) == pytest.approx(-turned / step_s, abs=1e-3)


def test_a_yaw_setpoint_turns_at_the_rate_across_the_wrap() -> None:
    setpoint = yaw_setpoint(0.5)
    setpoint.reset(math.pi - 0.01)

    assert setpoint.advance(0.4, 0.05, math.pi - 0.01) == pytest.approx(0.4)
    assert setpoint.angle_rad == pytest.approx(-math.pi + 0.01)


@given(st.lists(st.tuples(st.floats(-0.5, 0.5), st.floats(0.001, 0.1)), min_size=1, max_size=60), ANGLES)
def test_a_yaw_setpoint_never_runs_away_from_a_vehicle_that_does_not_turn(
    commands: list[tuple[float, float]], stuck_at: float
) -> None:
    setpoint = yaw_setpoint(0.5)

    for rate, elapsed in commands:
        flown = setpoint.advance(rate, elapsed, stuck_at)
        assert setpoint.angle_rad is not None
        assert abs(frames.wrap(setpoint.angle_rad - stuck_at)) <= setpoint.lead_rad + 1e-9
        assert flown * rate >= 0
        assert abs(flown) <= abs(rate) + 1e-12


def test_a_pitch_setpoint_stops_at_its_limits_and_says_so() -> None:
    setpoint = AngleSetpoint(1.0, (1.0, 1.5))
    setpoint.reset(1.48)

    assert setpoint.advance(0.5, 0.1, 1.48) == pytest.approx(0.2)
    assert setpoint.angle_rad == 1.5
    assert setpoint.advance(0.5, 0.1, 1.5) == 0.0


@given(TILTS, TILTS, ANGLES)
def test_an_attitude_seen_from_outside_is_the_one_that_px4_means(roll: float, pitch: float, yaw: float) -> None:
    forward_left_up = frames.NED_TO_WORLD @ frames.body_rotation(roll, pitch, yaw) @ np.diag([1.0, -1.0, -1.0])
    found = frames.ned_attitude(forward_left_up)
    assert found[:2] == pytest.approx((roll, pitch), abs=1e-9)
    assert math.remainder(found[2] - yaw, math.tau) == pytest.approx(0.0, abs=1e-9)


def test_a_level_body_that_looks_along_x_heads_east() -> None:
    assert frames.ned_attitude(np.eye(3)) == pytest.approx((0.0, 0.0, math.pi / 2))
