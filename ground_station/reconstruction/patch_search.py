"""Finds a small patch of one image in another: where it should be is known roughly, from poses that are known roughly.

The patch is first drawn as the other camera would see it, if it lay on a plane parallel to its own image. Then it is
compared at every pixel around the line on which it must lie, by correlation, so that light may differ.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from protocol.geometry import Floats

RADIUS: Final = 4
"""Of the patch, in pixels: 9 x 9."""
SIDE: Final = 2 * RADIUS + 1
NOISE_VARIANCE: Final = 4.0
"""Added to variances of grey levels, as in the sweep: what is flat correlates with nothing."""
LIKE_MIN: Final = 0.75
"""Correlation from which two patches may show the same."""
LEAD_MIN: Final = 0.05
"""By how much it must beat the next best place: repeated patterns are not taken."""
RIVAL_PX: Final = 3.0
"""Places closer than this to the best are the same place, not rivals."""
ZOOM_MAX: Final = 2.0
"""Largest change of the patch's size, in area."""


@njit(cache=True, nogil=True, error_model="numpy")
def project(
    ray: Floats, inverse_depth: float, turn: Floats, shift: Floats, focal: Floats
) -> tuple[float, float, float]:
    """Column, row and depth over own depth of the point at ``ray`` (3,), z = 1; ``turn`` and ``shift`` take it over.

    ``focal`` (4,): focal lengths and principal point, in pixel indices, of the other camera.
    """
    x = turn[0, 0] * ray[0] + turn[0, 1] * ray[1] + turn[0, 2] * ray[2] + inverse_depth * shift[0]
    y = turn[1, 0] * ray[0] + turn[1, 1] * ray[1] + turn[1, 2] * ray[2] + inverse_depth * shift[1]
    z = turn[2, 0] * ray[0] + turn[2, 1] * ray[1] + turn[2, 2] * ray[2] + inverse_depth * shift[2]
    if z < 1e-3:
        return -1.0, -1.0, -1.0
    return focal[0] * x / z + focal[2], focal[1] * y / z + focal[3], z


@njit(cache=True, nogil=True, error_model="numpy")
def draw_patch(
    image: NDArray[np.uint8],
    corner: Floats,
    own: Floats,
    inverse_depth: float,
    turn: Floats,
    shift: Floats,
    focal: Floats,
    patch: NDArray[np.float32],
) -> bool:
    """Fill ``patch`` (S, S), mean 0 and length 1, with what the other camera sees of ``image`` around ``corner``.

    ``own`` (4,) is the camera of ``image``. False if it sees it too large, too small, or nothing in it.
    """
    ray = np.array([(corner[0] - own[2]) / own[0], (corner[1] - own[3]) / own[1], 1.0])
    u, v, z = project(ray, inverse_depth, turn, shift, focal)
    right = np.array([ray[0] + 1.0 / own[0], ray[1], 1.0])
    below = np.array([ray[0], ray[1] + 1.0 / own[1], 1.0])
    ru, rv, rz = project(right, inverse_depth, turn, shift, focal)
    bu, bv, bz = project(below, inverse_depth, turn, shift, focal)
    if z < 0 or rz < 0 or bz < 0:
        return False
    a, b, c, d = ru - u, bu - u, rv - v, bv - v
    area = a * d - b * c
    if area < 1 / ZOOM_MAX or area > ZOOM_MAX:
        return False
    height, width = image.shape
    total, square = 0.0, 0.0
    for j in range(SIDE):
        for i in range(SIDE):
            across, down = i - RADIUS, j - RADIUS
            x = corner[0] + (d * across - b * down) / area
            y = corner[1] + (a * down - c * across) / area
            if x < 0 or y < 0 or x >= width - 1 or y >= height - 1:
                return False
            column, row = int(x), int(y)
            p, q = np.float32(x - column), np.float32(y - row)
            upper = _mix(image[row, column], image[row, column + 1], p)
            lower = _mix(image[row + 1, column], image[row + 1, column + 1], p)
            value = upper + q * (lower - upper)
            patch[j, i] = value
            total += float(value)
            square += float(value) * float(value)
    count = SIDE * SIDE
    spread = square - total * total / count
    if spread < NOISE_VARIANCE * count:
        return False
    mean, scale = np.float32(total / count), np.float32(1 / np.sqrt(spread + NOISE_VARIANCE * count))
    for j in range(SIDE):
        for i in range(SIDE):
            patch[j, i] = (patch[j, i] - mean) * scale
    return True


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _mix(first: np.uint8, second: np.uint8, share: np.float32) -> np.float32:
    start = np.float32(np.int32(first))
    return start + share * (np.float32(np.int32(second)) - start)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _likeness(image: NDArray[np.uint8], patch: NDArray[np.float32], column: int, row: int) -> float:
    """Correlation of the patch with the image around a pixel."""
    total, square, product = np.float32(0), np.float32(0), np.float32(0)
    for j in range(SIDE):
        for i in range(SIDE):
            value = np.float32(np.int32(image[row - RADIUS + j, column - RADIUS + i]) - 128)
            total += value
            square += value * value
            product += value * patch[j, i]
    count = np.float32(SIDE * SIDE)
    spread = max(square - total * total / count, np.float32(0)) + np.float32(NOISE_VARIANCE) * count
    return float(product / np.sqrt(spread))


@njit(cache=True, nogil=True, error_model="numpy")
def search(
    image: NDArray[np.uint8], patch: NDArray[np.float32], line: tuple[float, float, float, float], radius: float
) -> tuple[float, float, float]:
    """Where ``patch`` lies in ``image``, within ``radius`` of the segment ``line``: column, row and correlation.

    Correlation 0 if it is not found, or if another place looks as much like it.
    """
    u0, v0, u1, v1 = line
    height, width = image.shape
    left = max(int(np.ceil(min(u0, u1) - radius)), RADIUS)
    right = min(int(np.floor(max(u0, u1) + radius)), width - 1 - RADIUS)
    top = max(int(np.ceil(min(v0, v1) - radius)), RADIUS)
    bottom = min(int(np.floor(max(v0, v1) + radius)), height - 1 - RADIUS)
    if right < left or bottom < top:
        return 0.0, 0.0, 0.0
    along_u, along_v = u1 - u0, v1 - v0
    squared = max(along_u * along_u + along_v * along_v, 1e-9)
    scores = np.full((bottom - top + 1, right - left + 1), -1.0, np.float32)
    best, best_row, best_column = -1.0, 0, 0
    for row in range(top, bottom + 1):
        for column in range(left, right + 1):
            share = min(max(((column - u0) * along_u + (row - v0) * along_v) / squared, 0.0), 1.0)
            off_u, off_v = column - u0 - share * along_u, row - v0 - share * along_v
            if off_u * off_u + off_v * off_v > radius * radius:
                continue
            score = _likeness(image, patch, column, row)
            scores[row - top, column - left] = score
            if score > best:
                best, best_row, best_column = score, row, column
    if best < LIKE_MIN:
        return 0.0, 0.0, 0.0
    for row in range(top, bottom + 1):
        for column in range(left, right + 1):
            rival = scores[row - top, column - left] > best - LEAD_MIN
            if rival and (row - best_row) ** 2 + (column - best_column) ** 2 > RIVAL_PX * RIVAL_PX:
                return 0.0, 0.0, 0.0
    return _settle(image, patch, best_column, best_row, best)


@njit(cache=True, nogil=True, error_model="numpy")
def _settle(
    image: NDArray[np.uint8], patch: NDArray[np.float32], column: int, row: int, best: float
) -> tuple[float, float, float]:
    """The top of the parabolas through the correlations beside the best one."""
    height, width = image.shape
    inside = RADIUS < column < width - 1 - RADIUS and RADIUS < row < height - 1 - RADIUS
    if not inside:
        return 0.0, 0.0, 0.0
    left, right = _likeness(image, patch, column - 1, row), _likeness(image, patch, column + 1, row)
    above, below = _likeness(image, patch, column, row - 1), _likeness(image, patch, column, row + 1)
    if max(left, right, above, below) > best:  # the best lies outside the region: this is its slope
        return 0.0, 0.0, 0.0
    u = column + 0.5 * (left - right) / min(left - 2 * best + right, -1e-6)
    v = row + 0.5 * (above - below) / min(above - 2 * best + below, -1e-6)
    return u, v, best
