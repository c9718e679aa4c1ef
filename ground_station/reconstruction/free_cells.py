"""Which cells of the flight region are free: all that drones may enter below where nothing stands.

A cell is free when every voxel in it and on its faces was seen often enough to be part of the map, and seen through:
farther in front of any surface than half the truncation. What is at a surface, behind one, never seen or outside of the
mapped box is not. Of the cells that the mission vouches for, those are free in which no voxel was seen at or behind a
surface.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ground_station.reconstruction.fusion import Volume
from protocol.geometry import Floats
from protocol.obstacle_grid import Cells, ObstacleGrid

THROUGH: Final = 0.5
"""Share of the truncation that a voxel's mean distance must be in front of surfaces: one wrong depth in some right ones
does not fill a room, and noise of a surface keeps the cells at it."""
_ROUNDING: Final = 1e-4
"""Of a voxel."""


def free_cells(volume: Volume, weight_min: float, grid: ObstacleGrid) -> Cells:
    """[x, y, z] of ``grid``; voxels count from ``weight_min`` on."""
    found = _free_cells(
        grid.vouched,
        volume.distance,
        volume.weight,
        (grid.origin - volume.origin) / volume.voxel,
        grid.cell_m / volume.voxel,
        np.float32(weight_min),
        np.float32(THROUGH * volume.truncation),
    )
    return found | grid.stood_on


@njit(cache=True, nogil=True)
def _free_cells(
    vouched: Cells,
    distance: NDArray[np.float32],
    weight: NDArray[np.float32],
    offset: Floats,
    edge: float,
    weight_min: np.float32,
    through: np.float32,
) -> Cells:
    """``offset`` (3,) and ``edge`` of the cells in voxels."""
    shape = vouched.shape
    free = np.zeros(shape, np.bool_)
    low, high, cell = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3, np.int64)
    for cell[0] in range(shape[0]):
        for cell[1] in range(shape[1]):
            for cell[2] in range(shape[2]):
                inside = True
                for axis in range(3):
                    first = offset[axis] + edge * cell[axis]
                    low[axis] = int(np.ceil(first - 0.5 - _ROUNDING))
                    high[axis] = int(np.floor(first + edge + 0.5 + _ROUNDING)) + 1
                    inside = inside and low[axis] >= 0 and high[axis] <= distance.shape[axis]
                    low[axis], high[axis] = max(low[axis], 0), min(high[axis], distance.shape[axis])
                is_vouched = vouched[cell[0], cell[1], cell[2]]
                free[cell[0], cell[1], cell[2]] = (inside or is_vouched) and _is_clear(
                    distance, weight, low, high, weight_min, through, is_vouched
                )
    return free


@njit(cache=True, nogil=True)
def _is_clear(
    distance: NDArray[np.float32],
    weight: NDArray[np.float32],
    low: NDArray[np.int64],
    high: NDArray[np.int64],
    weight_min: np.float32,
    through: np.float32,
    is_vouched: bool,
) -> bool:
    """Whether all voxels of the range were seen through; of a vouched cell, all that were seen."""
    for i in range(low[0], high[0]):
        for j in range(low[1], high[1]):
            for k in range(low[2], high[2]):
                if weight[i, j, k] < weight_min:
                    if not is_vouched:
                        return False
                elif distance[i, j, k] < through:
                    return False
    return True
