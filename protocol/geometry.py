"""Camera and frame conventions: one place, because a wrong handedness ruins a map silently.

World frame: right-handed, z up, metres. A drone's pose is ``p = [x, y, z, yaw, pitch]`` in metres and
radians; *pitch is the depression angle*: 0 looks at the horizon, pi/2 straight down (Coverage-Recon,
notation of eq. (1), with the sign that departure 3 in ARCHITECTURE.md explains).
Camera frame (OpenCV): x right, y down, z forward. Pixel (column, row) covers the square
``[column, column + 1) x [row, row + 1)``, so its centre lies at ``(column + 0.5, row + 0.5)``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]


def optical_axis(yaw_rad: float, pitch_rad: float) -> Floats:
    """Unit vector the camera looks along, (3,), world frame."""
    horizontal = math.cos(pitch_rad)
    return np.array([math.cos(yaw_rad) * horizontal, math.sin(yaw_rad) * horizontal, -math.sin(pitch_rad)])


def camera_rotation(yaw_rad: float, pitch_rad: float) -> Floats:
    """Camera-to-world rotation, (3, 3); columns are the image's right, down and forward axes in the world.

    The image's right stays horizontal and is defined by the yaw alone, so the rotation is continuous
    when the camera looks straight down.
    """
    right = np.array([math.sin(yaw_rad), -math.cos(yaw_rad), 0.0])
    forward = optical_axis(yaw_rad, pitch_rad)
    return np.column_stack([right, np.cross(forward, right), forward])


def rotation_of_quaternion(quaternion: tuple[float, float, float, float]) -> Floats:
    """(3, 3) of w, x, y, z, of any length but none."""
    w, x, y, z = np.array(quaternion) / math.hypot(*quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def turn_matrix(vector: Floats) -> Floats:
    """(3, 3) rotation about ``vector`` by its length (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-8:
        nearly: Floats = np.eye(3) + cross
        return nearly
    matrix: Floats = np.eye(3) + np.sin(angle) / angle * cross + (1 - np.cos(angle)) / angle**2 * cross @ cross
    return matrix


def rotation_vector(matrix: Floats) -> Floats:
    """The inverse of `turn_matrix`, for angles well below pi."""
    skew = np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]) / 2
    sine = float(np.linalg.norm(skew))
    angle = float(np.arctan2(sine, (np.trace(matrix) - 1) / 2))
    vector: Floats = skew * (angle / sine if sine > 1e-8 else 1.0)
    return vector


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """Pinhole camera without distortion; focal lengths and principal point in pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    @classmethod
    def from_field_of_view(cls, width: int, height: int, horizontal_rad: float) -> Intrinsics:
        """Square pixels and a centred principal point; ``horizontal_rad`` is the full horizontal angle."""
        focal = width / 2 / math.tan(horizontal_rad / 2)
        return cls(width, height, focal, focal, width / 2, height / 2)

    def scaled_to(self, width: int, height: int) -> Intrinsics:
        """The same camera sampled at another resolution."""
        sx, sy = width / self.width, height / self.height
        return Intrinsics(width, height, self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy)
