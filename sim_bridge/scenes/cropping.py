"""Cutting triangles at the faces of a box."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protocol.geometry import Floats


def crop_to_box(
    triangles: NDArray[np.floating], lower: tuple[float, float, float], upper: tuple[float, float, float]
) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """The parts of ``triangles`` [T, 3, 3] inside the box, their winding kept.

    Returns corners [n, 3, 3], the barycentric weights [n, 3, 3] of each corner in its source triangle, and the
    source's row [n] (Sutherland and Hodgman 1974, one face of the box after another).
    """
    source = np.arange(len(triangles))
    weights = np.broadcast_to(np.eye(3), (len(triangles), 3, 3))
    corners = np.asarray(triangles, dtype=np.float64)
    for axis in range(3):
        for sign, bound in ((1.0, lower[axis]), (-1.0, upper[axis])):
            height = sign * (corners[:, :, axis] - bound)
            inside = height >= 0
            count = inside.sum(axis=1)
            parts = [(corners[count == 3], weights[count == 3], source[count == 3])]
            parts += _cut(corners, weights, source, height, inside, count)
            corners, weights, source = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return corners, weights, source


def _cut(
    corners: Floats,
    weights: Floats,
    source: NDArray[np.int64],
    height: Floats,
    inside: NDArray[np.bool_],
    count: NDArray[np.int64],
) -> list[tuple[Floats, Floats, NDArray[np.int64]]]:
    """One triangle where one corner is inside, two where one is outside."""
    parts = []
    for lonely in (1, 2):
        rows = np.flatnonzero(count == lonely)
        # Turn each triangle so that its odd corner comes first.
        odd = (inside[rows] == (lonely == 1)).argmax(axis=1)
        turn = (odd[:, None] + np.arange(3)) % 3
        row = rows[:, None]
        level = height[row, turn]
        both = np.concatenate([corners[row, turn], weights[row, turn]], axis=-1)
        to_second = (level[:, 0] / (level[:, 0] - level[:, 1]))[:, None]
        to_third = (level[:, 0] / (level[:, 0] - level[:, 2]))[:, None]
        first, second, third = both[:, 0], both[:, 1], both[:, 2]
        near_second = first + to_second * (second - first)
        near_third = first + to_third * (third - first)
        if lonely == 1:
            pieces = [np.stack([first, near_second, near_third], axis=1)]
        else:
            pieces = [
                np.stack([near_second, second, third], axis=1),
                np.stack([near_second, third, near_third], axis=1),
            ]
        parts += [(piece[..., :3], piece[..., 3:], source[rows]) for piece in pieces]
    return parts
