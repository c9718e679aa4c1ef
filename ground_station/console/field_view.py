"""The importance as coloured points: by how much is left of it, or by whose it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ground_station.palette import drone_colour
from protocol.field import VirtualField
from protocol.geometry import Floats, optical_axis
from protocol.mission import Sensing

Colours = NDArray[np.uint8]

POINT_LIMIT: Final = 30_000
"""A browser draws them fluently, and one frame of them is half a megabyte."""
_HEAT: Final = np.array(
    [
        (0, 0, 4),
        (22, 11, 57),
        (66, 10, 104),
        (106, 23, 110),
        (147, 38, 103),
        (188, 55, 84),
        (221, 81, 58),
        (243, 120, 25),
        (252, 165, 10),
        (246, 215, 70),
        (252, 255, 164),
    ],
    np.float64,
)
"""sRGB of matplotlib's colour map "inferno" (van der Walt and Smith, CC0) at 0, 0.1, ... 1."""
_DARKEST: Final = 0.15
"""Where of the table 0 is: black points on a dark scene would not be seen."""
_TINY_M: Final = 1e-9
"""A position inside a camera has no line of sight; this keeps it finite."""


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    points: NDArray[np.float32]
    """(n, 3) m, world."""
    colours: Colours
    """(n, 3) sRGB."""


class FieldView:
    def __init__(self, field: VirtualField, sensing: Sensing, limit: int = POINT_LIMIT) -> None:
        """``limit``: points at most; of a larger field every other position along each axis is left out, or more."""
        self._field = field
        self._sensing = sensing
        axes = (field.xs, field.ys, field.zs)
        stride = 1
        while np.prod([len(axis[::stride]) for axis in axes]) > limit:
            stride += 1
        grid = np.arange(field.shape[0]).reshape([len(axis) for axis in axes])
        self._rows = grid[::stride, ::stride, ::stride].ravel()
        self._points = field.positions()[self._rows]
        steps = [float(axis[1] - axis[0]) for axis in axes if len(axis) > 1]
        self._pitch_m = stride * min(steps, default=1.0)

    @property
    def pitch_m(self) -> float:
        """Least distance of two points, which their size on the screen should be a part of."""
        return self._pitch_m

    def by_importance(self, phi: NDArray[np.float32], hide_below: float) -> PointCloud:
        """Each position's mean of phi (positions, directions) over directions as `heat`; those below are left out."""
        rows, means = self._shown(phi, hide_below)
        return PointCloud(self._points[rows].astype(np.float32), heat(means))

    def by_owner(self, phi: NDArray[np.float32], hide_below: float, poses: Floats, colours: Colours) -> PointCloud:
        """Voronoi cells: each position in the colour of the drone that owns most of its directions.

        poses: (drones, 5), at least one, ordered by id; colours: (drones, 3). A tie goes to the lowest id.
        """
        rows, _ = self._shown(phi, hide_below)
        points = self._points[rows]
        return PointCloud(points.astype(np.float32), colours[self._owners(points, poses)])

    def _shown(self, phi: NDArray[np.float32], hide_below: float) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Which points, and their means."""
        means = phi[self._rows].mean(axis=1)
        rows = np.flatnonzero(means >= hide_below)
        return rows, means[rows]

    def _owners(self, points: Floats, poses: Floats) -> NDArray[np.int64]:
        """Row of ``poses`` that owns most cells of each point: the one with the largest h1 of eq. (1) owns a cell."""
        sensing, directions = self._sensing, self._field.directions.astype(np.float32).T
        exponents = np.empty((len(poses), len(points), directions.shape[1]), np.float32)
        for pose, exponent in zip(poses, exponents, strict=True):
            offset = points - pose[:3]
            distance = np.maximum(np.linalg.norm(offset, axis=1), _TINY_M)
            sight = offset / distance[:, None]
            off_axis = (1 - sight @ optical_axis(pose[3], pose[4])) / sensing.sigma_axis
            off_distance = (distance - sensing.distance_m) / sensing.sigma_distance_m
            off_view = (1 + sight.astype(np.float32) @ directions) / np.float32(sensing.sigma_view)
            exponent[:] = off_view**2 + (off_axis**2 + off_distance**2).astype(np.float32)[:, None]
        owners = exponents.argmin(axis=0)
        votes = np.stack([(owners == drone).sum(axis=1) for drone in range(len(poses))])
        winners: NDArray[np.int64] = votes.argmax(axis=0)
        return winners


def heat(values: Floats | NDArray[np.float32]) -> Colours:
    """(n,) -> (n, 3) sRGB: violet at 0, through red, to pale yellow at 1 and above; equal steps look equal."""
    places = (len(_HEAT) - 1) * (_DARKEST + (1 - _DARKEST) * np.clip(values.astype(np.float64), 0, 1))
    known = np.arange(len(_HEAT))
    return np.stack([np.interp(places, known, channel) for channel in _HEAT.T], axis=1).round().astype(np.uint8)


def drone_colours(indices: Sequence[int]) -> Colours:
    """(n, 3) sRGB, as in the report, by each drone's place in the mission."""
    return np.array([list(bytes.fromhex(drone_colour(index)[1:])) for index in indices], np.uint8).reshape(-1, 3)
