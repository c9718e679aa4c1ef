"""A wrong handedness ruins a map silently."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.geometry import Intrinsics, camera_rotation, optical_axis, rotation_vector, turn_matrix

yaws = st.floats(-10, 10)
pitches = st.floats(-math.pi / 2, math.pi / 2)
reproducible = settings(derandomize=True, deadline=None)


@reproducible
@given(yaw=yaws, pitch=pitches)
def test_a_camera_rotation_is_a_rotation_that_looks_along_the_optical_axis(yaw: float, pitch: float) -> None:
    rotation = camera_rotation(yaw, pitch)

    assert rotation.T @ rotation == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert rotation[:, 2] == pytest.approx(optical_axis(yaw, pitch))


@reproducible
@given(yaw=yaws, pitch=pitches)
def test_the_image_is_level_and_upright(yaw: float, pitch: float) -> None:
    right, down, _ = camera_rotation(yaw, pitch).T

    assert right[2] == 0.0
    assert down[2] <= 1e-12


def test_a_camera_at_the_horizon_along_x_has_y_to_its_left_and_z_above() -> None:
    right, down, forward = camera_rotation(0.0, 0.0).T

    assert forward == pytest.approx([1, 0, 0])
    assert right == pytest.approx([0, -1, 0])
    assert down == pytest.approx([0, 0, -1])


def test_yaw_turns_from_x_to_y_and_pitch_turns_down() -> None:
    assert optical_axis(math.pi / 2, 0.0) == pytest.approx([0, 1, 0])
    assert optical_axis(0.0, math.pi / 2) == pytest.approx([0, 0, -1])
    assert optical_axis(0.0, math.pi / 4) == pytest.approx([math.sqrt(0.5), 0, -math.sqrt(0.5)])


def test_a_camera_straight_down_has_its_heading_at_the_top_of_the_image() -> None:
    for yaw in (0.0, 1.0, -2.5):
        right, down, _ = camera_rotation(yaw, math.pi / 2).T

        assert down == pytest.approx([-math.cos(yaw), -math.sin(yaw), 0], abs=1e-12)
        assert right == pytest.approx([math.sin(yaw), -math.cos(yaw), 0])


@reproducible
@given(yaw=yaws)
def test_the_rotation_is_continuous_where_the_camera_looks_straight_down(yaw: float) -> None:
    step = 1e-6
    before, at, after = (camera_rotation(yaw, math.pi / 2 + offset) for offset in (-step, 0.0, step))

    assert np.abs(at - before).max() <= 2 * step
    assert np.abs(after - at).max() <= 2 * step


def test_a_point_on_the_image_s_right_edge_lies_at_half_the_field_of_view() -> None:
    camera = Intrinsics.from_field_of_view(640, 360, math.radians(90))

    assert (camera.fx, camera.fy) == pytest.approx((320, 320))
    assert (camera.cx, camera.cy) == (320, 180)
    assert camera.fx * math.tan(math.radians(45)) + camera.cx == pytest.approx(640)


@reproducible
@given(width=st.integers(32, 4096), height=st.integers(32, 4096), x=st.floats(-1, 1), y=st.floats(-1, 1))
def test_a_scaled_camera_sees_a_ray_at_the_same_share_of_its_image(width: int, height: int, x: float, y: float) -> None:
    camera = Intrinsics(320, 180, 200.0, 210.0, 150.0, 95.0)

    scaled = camera.scaled_to(width, height)

    assert (scaled.width, scaled.height) == (width, height)
    assert (scaled.fx * x + scaled.cx) / width == pytest.approx((camera.fx * x + camera.cx) / 320)
    assert (scaled.fy * y + scaled.cy) / height == pytest.approx((camera.fy * y + camera.cy) / 180)


@reproducible
@given(vector=st.tuples(*[st.floats(-1.7, 1.7)] * 3))
def test_a_turn_has_the_axis_and_angle_of_its_vector(vector: tuple[float, float, float]) -> None:
    matrix = turn_matrix(np.array(vector))

    assert matrix @ matrix.T == pytest.approx(np.eye(3), abs=1e-9)
    assert matrix @ np.array(vector) == pytest.approx(vector, abs=1e-9)
    assert rotation_vector(matrix) == pytest.approx(vector, abs=1e-6)


def test_a_quarter_turn_about_z_takes_x_to_y() -> None:
    assert turn_matrix(np.array([0, 0, math.pi / 2])) @ [1, 0, 0] == pytest.approx([0, 1, 0])
