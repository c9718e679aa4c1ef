"""When a camera has moved enough for another keyframe, the rule by which cameras save bandwidth; and what one is."""

from __future__ import annotations

import math

import numpy as np

from protocol.geometry import Floats, Intrinsics
from protocol.map_settings import Camera
from protocol.messages import Keyframe


class KeyframeRule:
    """For one camera: by baseline or by angle, whichever comes first."""

    def __init__(self, camera: Camera) -> None:
        self._baseline_m = camera.keyframe_baseline_m
        self._cosine = math.cos(camera.keyframe_angle_rad)
        self._last: tuple[Floats, Floats] | None = None

    def wants(self, position: Floats, rotation: Floats) -> bool:
        """Whether a frame at ``position`` (3,), camera-to-world ``rotation`` (3, 3), is a keyframe; if so, remember."""
        if self._last is not None:
            moved = math.dist(position, self._last[0])
            turned_cosine = (float(np.sum(rotation * self._last[1])) - 1) / 2  # trace of R^T R' = 1 + 2 cos
            if moved < self._baseline_m and turned_cosine > self._cosine:
                return False
        self._last = (position.copy(), rotation.copy())
        return True


def make_keyframe(
    drone: int,
    sequence: int,
    tick: int,
    position: Floats,
    rotation: Floats,
    intrinsics: Intrinsics,
    jpeg: bytes,
    depth: bytes = b"",
    deviations: tuple[float, float] = (0.0, 0.0),
) -> Keyframe:
    """``position`` (3,) and ``rotation`` (3, 3), camera to world, are those of the camera; ``deviations`` their
    standard deviations, m and rad."""
    x_row, y_row, z_row = rotation.tolist()
    return Keyframe(
        drone=drone,
        sequence=sequence,
        tick=tick,
        position=tuple(position.tolist()),
        rotation=(tuple(x_row), tuple(y_row), tuple(z_row)),
        width=intrinsics.width,
        height=intrinsics.height,
        fx=intrinsics.fx,
        fy=intrinsics.fy,
        cx=intrinsics.cx,
        cy=intrinsics.cy,
        jpeg=jpeg,
        depth=depth,
        position_sd_m=deviations[0],
        angle_sd_rad=deviations[1],
    )
