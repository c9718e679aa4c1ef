"""Rows of the QP from cells that are not free: near cells merged into boxes, and those of the boxes that can matter.

With b_i the distance of the predicted position y from box i, less D, and B the smallest of them, every box's row is

    n_i . u >= -(a B + (b_i - B) / H)

a the gain, H the longest time for which a velocity is flown without a new one. The distance from a box is convex, so
b_i(y + t u) >= b_i + t n_i . u >= (1 - t/H) (b_i - B) + (1 - a t) B for every t <= H: not negative where B is not, and
at t = H no less than (1 - a H) B. So B, the barrier of all that is not free, keeps the same promise as that of a zone.
A row -a b_i for every box, as zones have, would promise the same and forbid more: sliding along a wall of many small
boxes, a drone would be slowed down by each one's corner.

Two kinds of rows are left out, neither of which any |u| <= top speed V can break: a B + (b_i - B) / H >= V; and those
that another one implies, c_i >= c_j + |n_i - n_j| V, where c is the right side without its sign.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from protocol.geometry import Floats
from protocol.obstacle_grid import Cells


@njit(cache=True, nogil=True)
def _gap(point: Floats, axis: int, low: float, high: float) -> float:
    """Along one axis, signed: towards where the point lies beyond [low, high]."""
    value = float(point[axis])
    return min(value - low, 0.0) if value < low else max(value - high, 0.0)


@njit(cache=True, nogil=True)
def _window(point: Floats, reach: float, origin: Floats, cell: float, shape: tuple[int, int, int]) -> NDArray[np.int64]:
    """[axis, (first, end)] of the cells that may be within ``reach``."""
    window = np.empty((3, 2), np.int64)
    for axis in range(3):
        first = math.floor((point[axis] - reach - origin[axis]) / cell)
        end = math.floor((point[axis] + reach - origin[axis]) / cell) + 1
        window[axis, 0] = min(max(first, 0), shape[axis])
        window[axis, 1] = min(max(end, 0), shape[axis])
    return window


@njit(cache=True, nogil=True)
def nearest_distance(point: Floats, free: Cells, origin: Floats, cell: float, reach: float) -> float:
    """Of ``point`` (3,) from the cells that are not free; inf if that is more than ``reach``."""
    window = _window(point, reach, origin, cell, free.shape)
    least = reach * reach
    found = False
    for i in range(window[0, 0], window[0, 1]):
        x = _gap(point, 0, origin[0] + cell * i, origin[0] + cell * (i + 1))
        if x * x > least:
            continue
        for j in range(window[1, 0], window[1, 1]):
            y = _gap(point, 1, origin[1] + cell * j, origin[1] + cell * (j + 1))
            if x * x + y * y > least:
                continue
            for k in range(window[2, 0], window[2, 1]):
                if free[i, j, k]:
                    continue
                z = _gap(point, 2, origin[2] + cell * k, origin[2] + cell * (k + 1))
                square = x * x + y * y + z * z
                if square <= least:
                    least = square
                    found = True
    return math.sqrt(least) if found else math.inf


@njit(cache=True, nogil=True)
def _is_full(left: Cells, i: int, end_i: int, j: int, end_j: int, k: int, end_k: int) -> bool:
    """Whether all of that part of ``left`` is still left. Written out, because slices take seconds to compile."""
    for x in range(i, end_i):
        for y in range(j, end_j):
            for z in range(k, end_k):
                if not left[x, y, z]:
                    return False
    return True


@njit(cache=True, nogil=True)
def _merge(free: Cells, window: NDArray[np.int64]) -> NDArray[np.int64]:
    """Boxes (n, 6), first and end cell along each axis, that hold all cells of the window that are not free and none
    that is; each grown along z, then y, then x."""
    x0, y0, z0 = window[0, 0], window[1, 0], window[2, 0]
    nx, ny, nz = window[0, 1] - x0, window[1, 1] - y0, window[2, 1] - z0
    left = np.empty((nx, ny, nz), np.bool_)
    count = 0
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                left[i, j, k] = not free[x0 + i, y0 + j, z0 + k]
                count += left[i, j, k]
    boxes = np.empty((count, 6), np.int64)
    found = 0
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                if not left[i, j, k]:
                    continue
                end_i, end_j, end_k = i + 1, j + 1, k + 1
                while end_k < nz and left[i, j, end_k]:
                    end_k += 1
                while end_j < ny and _is_full(left, i, end_i, end_j, end_j + 1, k, end_k):
                    end_j += 1
                while end_i < nx and _is_full(left, end_i, end_i + 1, j, end_j, k, end_k):
                    end_i += 1
                for x in range(i, end_i):
                    for y in range(j, end_j):
                        for z in range(k, end_k):
                            left[x, y, z] = False
                boxes[found, 0], boxes[found, 1] = x0 + i, x0 + end_i
                boxes[found, 2], boxes[found, 3] = y0 + j, y0 + end_j
                boxes[found, 4], boxes[found, 5] = z0 + k, z0 + end_k
                found += 1
    return boxes[:found]


@njit(cache=True, nogil=True)
def _choose(normals: Floats, rights: Floats, count: int, speed: float) -> NDArray[np.int64]:
    """Of the first ``count`` rows n . u >= -c, with ``rights`` c, those that another one does not imply and that can be
    broken, as c grows; the first one always."""
    chosen = np.empty(count, np.int64)
    waiting = np.ones(count, np.bool_)
    taken = 0
    for _ in range(count):
        row = -1
        for other in range(count):
            if waiting[other] and (row < 0 or rights[other] < rights[row]):
                row = other
        waiting[row] = False
        needed = taken == 0 or rights[row] < speed
        for k in range(taken):
            apart = 0.0
            for axis in range(3):
                apart += (normals[row, axis] - normals[chosen[k], axis]) ** 2
            if rights[row] >= rights[chosen[k]] + math.sqrt(apart) * speed:
                needed = False
                break
        if needed:
            chosen[taken] = row
            taken += 1
    return chosen[:taken]


@njit(cache=True, nogil=True)
def obstacle_rows(
    point: Floats,
    free: Cells,
    origin: Floats,
    cell: float,
    kept: float,
    speed: float,
    gain: float,
    hold: float,
) -> tuple[Floats, Floats, Floats]:
    """Normals (n, 3), right sides (n,) and barriers (n,) of the rows at the predicted ``point`` (3,).

    ``kept``: D. ``speed``: V. ``gain``: a. ``hold``: H. The box that is nearest is always among them if its barrier is
    below V / a, and the first.
    """
    nearest = nearest_distance(point, free, origin, cell, kept + speed / gain)
    if nearest == math.inf:
        return np.empty((0, 3)), np.empty(0), np.empty(0)
    smallest = nearest - kept
    reach = nearest + max(0.0, (speed - gain * smallest) * hold) + cell * 1e-6
    boxes = _merge(free, _window(point, reach, origin, cell, free.shape))
    normals, rights, barriers = np.zeros((len(boxes), 3)), np.empty(len(boxes)), np.empty(len(boxes))
    count = 0
    for box in range(len(boxes)):
        square = 0.0
        for axis in range(3):
            low, high = origin[axis] + cell * boxes[box, 2 * axis], origin[axis] + cell * boxes[box, 2 * axis + 1]
            gap = _gap(point, axis, low, high)
            normals[count, axis] = gap
            square += gap * gap
        distance = math.sqrt(square)
        if distance > reach:
            continue
        if distance > 0.0:
            for axis in range(3):
                normals[count, axis] /= distance
        else:  # in it: above is where nothing stands
            normals[count, 2] = 1.0
        barriers[count] = distance - kept
        rights[count] = gain * smallest + (barriers[count] - smallest) / hold
        count += 1
    chosen = _choose(normals, rights, count, speed)
    return normals[chosen], -rights[chosen], barriers[chosen]
