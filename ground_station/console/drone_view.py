"""Drones in the scene: how a camera is turned, and the path that it came along."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from protocol.messages import Vector3

STEP_M: Final = 0.05
"""Finer than what is seen of a room on a screen."""
CAPACITY: Final = 1000


def orientation(yaw_rad: float, pitch_rad: float) -> tuple[float, float, float, float]:
    """`protocol.geometry.camera_rotation`, camera to world, as a unit quaternion w, x, y, z.

    A camera that looks along the world's x with its right along -y has q0 = (1, -1, 1, -1) / 2; pitching down turns it
    about its own right axis, yaw about the world's z.
    """
    half_yaw, half_pitch = yaw_rad / 2, -pitch_rad / 2
    level = np.array([0.5, -0.5, 0.5, -0.5])
    about_right = np.array([math.cos(half_pitch), math.sin(half_pitch), 0.0, 0.0])
    about_up = np.array([math.cos(half_yaw), 0.0, 0.0, math.sin(half_yaw)])
    w, x, y, z = _product(about_up, _product(level, about_right)).tolist()
    return w, x, y, z


def _product(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Hamilton's product of two quaternions w, x, y, z."""
    scalar = a[0] * b[0] - a[1:] @ b[1:]
    return np.array([scalar, *(a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:]))])


class Trail:
    """A path in a bounded number of points: when they are too many, every other one goes and the step doubles."""

    def __init__(self, step_m: float = STEP_M, capacity: int = CAPACITY) -> None:
        """``step_m``: least distance between two points at the start."""
        self._step_m = step_m
        self._capacity = capacity
        self._points: list[Vector3] = []
        self._newest: Vector3 | None = None

    def add(self, position: Vector3) -> None:
        self._newest = position
        if self._points and math.dist(position, self._points[-1]) < self._step_m:
            return
        self._points.append(position)
        if len(self._points) > self._capacity:
            del self._points[1::2]
            self._step_m *= 2

    @property
    def points(self) -> NDArray[np.float32]:
        """(n, 3) m, world, oldest first, up to the newest position; capacity + 1 at most."""
        points = list(self._points)
        if self._newest is not None and points[-1] != self._newest:
            points.append(self._newest)
        return np.array(points, np.float32).reshape(-1, 3)

    @property
    def segments(self) -> NDArray[np.float32]:
        """(n - 1, 2, 3): from each of `points` to the next; empty for fewer than two."""
        points = self.points
        return np.stack([points[:-1], points[1:]], axis=1)
