"""The way through what was seen free up to where nothing stands: for drones that go home, or that obstacles hold.

A breadth-first search over the cells at whose centre a drone may be, from all of those above `Obstacles.clear_m` at
once. So every cell knows its next one, and a drone that is pushed aside goes on from where it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agents.obstacles import Obstacles
from protocol.geometry import Floats
from protocol.obstacle_grid import Cells

SEARCH_CELLS = 4
"""How far around a drone a cell is looked for from which there is a way."""
AHEAD_CELLS = 8
"""Cells along the way that are gone to in one straight line, if all that it passes may be flown through."""
SAMPLES = 4
"""Places looked at along a line, for each cell of its length."""


@dataclass(frozen=True, slots=True)
class Ascent:
    end: Floats
    """(3,) where to fly straight."""
    left_m: float
    """Length of the way from here."""


class WayUp:
    def __init__(self, obstacles: Obstacles) -> None:
        self._obstacles = obstacles
        self._of: Cells | None = None
        """The map that the steps are of."""
        self._steps: NDArray[np.int32] = np.empty((0, 0, 0), np.int32)

    def rehearse(self) -> None:
        """Search once, so that nothing is left to be compiled in flight."""
        _follow(_search(self._obstacles), np.zeros(3, np.int64), SEARCH_CELLS, AHEAD_CELLS)

    def ascent(self, place: Floats) -> Ascent | None:
        """From ``place`` (3,); None where nothing is in the way any more. Straight up where no way is known."""
        obstacles, grid = self._obstacles, self._obstacles.grid
        if place[2] >= obstacles.clear_m:
            return None
        straight = np.array([place[0], place[1], obstacles.clear_m + grid.cell_m])
        if self._of is not obstacles.free:
            self._of, self._steps = obstacles.free, _search(obstacles)
        cell = np.floor((place - grid.origin) / grid.cell_m).astype(np.int64)
        way = _follow(self._steps, cell, SEARCH_CELLS, AHEAD_CELLS)
        if not len(way):
            return Ascent(straight, float(straight[2] - place[2]))
        centres = grid.origin + grid.cell_m * (way + 0.5)
        left_m = float(self._steps[tuple(way[0])]) * grid.cell_m
        if centres[-1][2] >= obstacles.clear_m and np.ptp(way[:, 0]) == np.ptp(way[:, 1]) == 0:
            return Ascent(straight, left_m)
        chosen = next((end for end in centres[:0:-1] if self._is_clear(place, end)), centres[0])
        if np.linalg.norm(chosen - place) < grid.cell_m / 2 and len(centres) > 1:
            chosen = centres[1]
        return Ascent(chosen, left_m)

    def _is_clear(self, place: Floats, end: Floats) -> bool:
        """Whether the line between two places (3,) goes through cells with steps alone."""
        grid = self._obstacles.grid
        count = max(2, round(SAMPLES * float(np.linalg.norm(end - place)) / grid.cell_m))
        line = place + np.linspace(0.0, 1.0, count)[1:, None] * (end - place)
        cells = np.floor((line - grid.origin) / grid.cell_m).astype(np.int64)
        inside = ((cells >= 0) & (cells < self._steps.shape)).all(axis=1)
        return bool(inside.all()) and bool((self._steps[tuple(cells.T)] >= 0).all())


def _search(obstacles: Obstacles) -> NDArray[np.int32]:
    """[x, y, z], with layers above the lattice: cells from each to above `Obstacles.clear_m`, -1 where there is no way
    or nobody may be."""
    from scipy.ndimage import distance_transform_edt  # of no use to missions without obstacles

    grid = obstacles.grid
    above = int(np.ceil((obstacles.clear_m - grid.origin[2]) / grid.cell_m)) + 1 - grid.shape[2]
    free = np.pad(obstacles.free, ((0, 0), (0, 0), (0, max(above, 1))), constant_values=True)
    if free.all():
        return np.zeros(free.shape, np.int32)
    # From centre to centre; the next cell's face is half a cell nearer, its corner at the most 0.87 of one.
    distance = distance_transform_edt(free, sampling=grid.cell_m)
    passable = distance >= obstacles.kept_m + 0.5 * grid.cell_m
    return _spread(np.ascontiguousarray(passable))


@njit(cache=True, nogil=True)
def _spread(passable: Cells) -> NDArray[np.int32]:
    """Steps from each passable cell to the uppermost layer, by faces."""
    nx, ny, nz = passable.shape
    steps = np.full((nx, ny, nz), -1, np.int32)
    queue = np.empty((nx * ny * nz, 3), np.int32)
    end = 0
    for i in range(nx):
        for j in range(ny):
            if passable[i, j, nz - 1]:
                steps[i, j, nz - 1] = 0
                queue[end, 0], queue[end, 1], queue[end, 2] = i, j, nz - 1
                end += 1
    begin = 0
    while begin < end:
        i, j, k = queue[begin]
        begin += 1
        for direction in range(6):
            shift = 1 if direction % 2 else -1
            axis = direction // 2
            x, y, z = i + (axis == 0) * shift, j + (axis == 1) * shift, k + (axis == 2) * shift
            if 0 <= x < nx and 0 <= y < ny and 0 <= z < nz and passable[x, y, z] and steps[x, y, z] < 0:
                steps[x, y, z] = steps[i, j, k] + 1
                queue[end, 0], queue[end, 1], queue[end, 2] = x, y, z
                end += 1
    return steps


@njit(cache=True, nogil=True)
def _follow(steps: NDArray[np.int32], cell: NDArray[np.int64], reach: int, ahead: int) -> NDArray[np.int64]:
    """(n, 3) the way's next cells, from the one that is nearest to ``cell`` on; empty where none is near."""
    best = (reach + 1) * (reach + 1) * 3
    current = np.full(3, -1, np.int64)
    for i in range(max(cell[0] - reach, 0), min(cell[0] + reach + 1, steps.shape[0])):
        for j in range(max(cell[1] - reach, 0), min(cell[1] + reach + 1, steps.shape[1])):
            for k in range(max(cell[2] - reach, 0), min(cell[2] + reach + 1, steps.shape[2])):
                square = (i - cell[0]) ** 2 + (j - cell[1]) ** 2 + (k - cell[2]) ** 2
                if steps[i, j, k] >= 0 and square < best:
                    best = square
                    current[0], current[1], current[2] = i, j, k
    way = np.empty((ahead, 3), np.int64)
    if current[0] < 0:
        return way[:0]
    count = 0
    while count < ahead:
        way[count] = current
        count += 1
        left = steps[current[0], current[1], current[2]]
        moved = False
        for direction in range(6):
            # Up first: of ways of the same length the one that climbs at once.
            axis = 2 - direction // 2
            following = current.copy()
            following[axis] += -1 if direction % 2 else 1
            if left == 0 or not 0 <= following[axis] < steps.shape[axis]:
                continue
            if steps[following[0], following[1], following[2]] == left - 1:
                current = following
                moved = True
                break
        if not moved:
            break
    return way[:count]
