"""Motion blur: what a camera that moves gathers while its shutter is open, byte for byte repeatable.

A sensor adds up light, and images say it by the curve of sRGB; so the mean is taken of light, in whole numbers.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from protocol.geometry import Floats, Intrinsics
from sim_bridge.camera import Camera

STEP_PX = 0.5
"""Largest motion of the image between two renderings that are added up."""
_FULL = 65535


def expose(
    camera: Camera, pose: Floats, velocity: Floats, exposure_s: float, intrinsics: Intrinsics, distance_m: float
) -> NDArray[np.uint8]:
    """Image [H, W, 3] of a camera that is at ``pose`` (5,) in the middle of the exposure, and moves by ``velocity``
    (5,), m/s and rad/s. ``distance_m``: of what is looked at, which says how often it has to be rendered."""
    count = renderings(velocity, exposure_s, intrinsics, distance_m)
    if count == 1:
        return camera.render(pose.tolist())
    # The middles of equal parts of the exposure.
    times_s = exposure_s * ((np.arange(count) + 0.5) / count - 0.5)
    light = np.zeros((intrinsics.height, intrinsics.width, 3), np.uint32)
    for time_s in times_s.tolist():
        light += _light_of_value()[camera.render((pose + time_s * velocity).tolist())]
    mean = (light + count // 2) // count
    return _value_of_light()[mean]


def renderings(velocity: Floats, exposure_s: float, intrinsics: Intrinsics, distance_m: float) -> int:
    """1 for a camera that stands still."""
    moved_px = intrinsics.fx * exposure_s * image_rate(velocity, distance_m)
    return 1 + math.ceil(moved_px / STEP_PX)


def image_rate(velocity: Floats, distance_m: float) -> float:
    """How fast the image moves, at most, in focal lengths a second, where the camera looks at ``distance_m``."""
    x, y, z, yaw, pitch = velocity.tolist()
    return math.hypot(x, y, z) / distance_m + math.hypot(yaw, pitch)


@cache
def _light_of_value() -> NDArray[np.uint32]:
    """(256,) by the sRGB standard, IEC 61966-2-1; 65535 is white."""
    value = np.arange(256) / 255
    light = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    whole: NDArray[np.uint32] = np.rint(_FULL * light).astype(np.uint32)
    return whole


@cache
def _value_of_light() -> NDArray[np.uint8]:
    """(65536,) the value whose light is nearest; every value's own light gives it back."""
    light = _light_of_value().astype(np.int64)
    return np.searchsorted((light[1:] + light[:-1]) // 2 + 1, np.arange(_FULL + 1), side="right").astype(np.uint8)
