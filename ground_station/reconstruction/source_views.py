"""Which keyframes, of all drones, one is compared with: far enough apart to triangulate, close enough to match.

The rating follows Goesele et al., "Multi-view stereo for community photo collections", 2007 (angle, scale, overlap,
and spread of the directions), on points at the expected depth instead of feature tracks.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ground_station.reconstruction.views import View
from protocol.geometry import Floats

BEST_ANGLE_RAD: Final = float(np.radians(7.5))
"""Triangulation angle rated highest; smaller ones are imprecise, larger ones match badly."""
ANGLE_SPREAD: Final = 0.5
"""Standard deviation of the rating over the logarithm of the angle."""
SCALE_MAX: Final = 1.6
"""Largest ratio of the two distances to the scene."""
OVERLAP_MIN: Final = 0.5
"""Least share of the sample points that the other view must show."""
SAMPLES: Final = ((0.5, 0.5), (0.2, 0.2), (0.8, 0.2), (0.2, 0.8), (0.8, 0.8))
"""Where in the image the sample points lie, as shares of its width and height; the first rates the angle."""
SAME_SIDE_DISCOUNT: Final = 0.5
"""Taken off a rating when a view in the same direction is chosen: what hides a point from one, hides it from both."""
RATING_MIN: Final = 0.02


class ViewIndex:
    """The poses of the newest ``capacity`` views. Finding sources is one linear scan; 2048 poses take some 0.1 ms."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._added = 0
        self._projections = np.zeros((capacity, 3, 4))
        self._centres = np.zeros((capacity, 3))
        self._sizes = np.zeros((capacity, 2))

    def __len__(self) -> int:
        return min(self._added, self._capacity)

    def add(self, view: View) -> int:
        """The view's slot, in [0, capacity); the oldest view loses its own when all are taken."""
        slot = self._added % self._capacity
        turn = view.calibration @ view.rotation.T
        self._projections[slot, :, :3] = turn
        self._projections[slot, :, 3] = -turn @ view.position
        self._centres[slot] = view.position
        self._sizes[slot] = view.intrinsics.width, view.intrinsics.height
        self._added += 1
        return slot

    def sources(self, view: View, depth: float, count: int) -> NDArray[np.int64]:
        """Slots of at most ``count`` views to compare ``view`` with, best first; ``depth`` m is where it mostly looks.

        The view itself is ruled out by its vanishing angle.
        """
        camera = view.intrinsics
        pixels = np.array([[across * camera.width, down * camera.height, 1.0] for across, down in SAMPLES])
        pixels[:, :2] -= 0.5
        points = view.position + depth * pixels @ np.linalg.inv(view.calibration).T @ view.rotation.T
        return _choose(view.position, points, self._projections, self._centres, self._sizes, len(self), count)


@njit(cache=True, nogil=True, error_model="numpy")
def _rate(
    position: Floats, points: Floats, projection: Floats, centre: Floats, size: Floats
) -> tuple[float, float, float, float]:
    """Rating in [0, 1] and unit direction from ``position`` to ``centre``, as seen from the scene."""
    ray_x, ray_y, ray_z = points[0, 0] - position[0], points[0, 1] - position[1], points[0, 2] - position[2]
    side_x, side_y, side_z = centre[0] - position[0], centre[1] - position[1], centre[2] - position[2]
    depth = np.sqrt(ray_x * ray_x + ray_y * ray_y + ray_z * ray_z)
    if side_x * side_x + side_y * side_y + side_z * side_z > depth * depth:
        return 0.0, 0.0, 0.0, 0.0
    along = (side_x * ray_x + side_y * ray_y + side_z * ray_z) / (depth * depth)
    side_x, side_y, side_z = side_x - along * ray_x, side_y - along * ray_y, side_z - along * ray_z
    apart = np.sqrt(side_x * side_x + side_y * side_y + side_z * side_z)
    ahead = depth * (1.0 - along)
    other_depth = np.sqrt(ahead * ahead + apart * apart)
    if apart <= 0.0 or ahead <= 0.0 or other_depth > SCALE_MAX * depth or depth > SCALE_MAX * other_depth:
        return 0.0, 0.0, 0.0, 0.0
    seen = 0
    for sample in range(points.shape[0]):
        u, v, w = projection[0, 3], projection[1, 3], projection[2, 3]
        for axis in range(3):
            u += projection[0, axis] * points[sample, axis]
            v += projection[1, axis] * points[sample, axis]
            w += projection[2, axis] * points[sample, axis]
        seen += 1 if w > 0.0 and 0.0 <= u <= w * (size[0] - 1.0) and 0.0 <= v <= w * (size[1] - 1.0) else 0
    overlap = seen / points.shape[0]
    if overlap < OVERLAP_MIN:
        return 0.0, 0.0, 0.0, 0.0
    deviation = np.log(np.arctan2(apart, ahead) / BEST_ANGLE_RAD) / ANGLE_SPREAD
    return overlap * np.exp(-0.5 * deviation * deviation), side_x / apart, side_y / apart, side_z / apart


@njit(cache=True, nogil=True, error_model="numpy")
def _choose(
    position: Floats,
    points: Floats,
    projections: Floats,
    centres: Floats,
    sizes: Floats,
    candidates: int,
    count: int,
) -> NDArray[np.int64]:
    ratings = np.zeros(candidates)
    directions = np.zeros((candidates, 3))
    for slot in range(candidates):
        rating, x, y, z = _rate(position, points, projections[slot], centres[slot], sizes[slot])
        ratings[slot] = rating
        directions[slot, 0], directions[slot, 1], directions[slot, 2] = x, y, z
    discounts = np.ones(candidates)
    chosen = np.empty(count, np.int64)
    for number in range(count):
        best, best_rating = -1, RATING_MIN
        for slot in range(candidates):
            if ratings[slot] * discounts[slot] > best_rating:
                best, best_rating = slot, ratings[slot] * discounts[slot]
        if best < 0:
            return chosen[:number]
        chosen[number] = best
        ratings[best] = 0.0
        for slot in range(candidates):
            same = 0.0
            for axis in range(3):
                same += directions[slot, axis] * directions[best, axis]
            discounts[slot] = min(discounts[slot], 1.0 - SAME_SIDE_DISCOUNT * max(same, 0.0))
    return chosen
