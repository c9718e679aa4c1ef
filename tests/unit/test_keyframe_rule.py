"""A keyframe is wanted when the camera moved or turned enough."""

from __future__ import annotations

import math

import numpy as np
import pytest

from protocol.geometry import Floats, camera_rotation
from protocol.keyframe_rule import KeyframeRule
from protocol.map_settings import Camera

CAMERA = Camera(keyframe_baseline_m=0.12, keyframe_angle_rad=math.radians(15))
ORIGIN = np.zeros(3)
AHEAD = camera_rotation(0.3, 1.2)


def rule() -> KeyframeRule:
    """One that has taken its first frame."""
    new = KeyframeRule(CAMERA)
    assert new.wants(ORIGIN, AHEAD)
    return new


def turned(axis: str, degrees: float) -> Floats:
    """``AHEAD`` turned about one of the camera's own axes."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    about = {"x": [[1, 0, 0], [0, c, -s], [0, s, c]], "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]]}
    about["z"] = [[c, -s, 0], [s, c, 0], [0, 0, 1]]
    rotation: Floats = AHEAD @ np.array(about[axis])
    return rotation


def test_the_first_frame_is_one_and_the_same_frame_again_is_not() -> None:
    assert not rule().wants(ORIGIN, AHEAD)


@pytest.mark.parametrize("direction", [(1, 0, 0), (0, -1, 0), (0, 0, 1), (0.6, 0, -0.8)])
def test_a_camera_that_moved_by_the_baseline_is_wanted(direction: tuple[float, ...]) -> None:
    assert not rule().wants(0.119 * np.array(direction), AHEAD)
    assert rule().wants(0.121 * np.array(direction), AHEAD)


@pytest.mark.parametrize("axis", ["x", "y", "z"])
@pytest.mark.parametrize("sign", [-1, 1])
def test_a_camera_that_turned_by_the_angle_about_any_axis_is_wanted(axis: str, sign: int) -> None:
    assert not rule().wants(ORIGIN, turned(axis, 14.9 * sign))
    assert rule().wants(ORIGIN, turned(axis, 15.1 * sign))
    assert rule().wants(ORIGIN, turned(axis, 180 * sign))


def test_moves_are_measured_from_the_last_keyframe_not_from_the_last_frame() -> None:
    steady = rule()

    wanted = [steady.wants(np.array([0.05 * step, 0, 0]), AHEAD) for step in range(1, 8)]

    assert wanted == [False, False, True, False, False, True, False]


def test_the_last_keyframe_stays_though_its_arrays_are_used_again() -> None:
    position, rotation = np.zeros(3), AHEAD.copy()
    strict = KeyframeRule(CAMERA)
    strict.wants(position, rotation)

    position[0] = 0.2
    assert strict.wants(position, rotation)
    rotation[:] = turned("y", 20)
    assert strict.wants(position, rotation)
