"""One depth per pixel from matching costs: semi-global aggregation, so that neighbours agree where texture is poor.

Hirschmueller, "Stereo processing by semiglobal matching and mutual information", 2008, eq. (13), along four paths:
rows and columns, both ways. Two raster passes; the second picks the winner, so that no aggregated volume is read
a third time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

STEP_PENALTY: Final = 10.0
"""P1: neighbours one plane apart, in the units of the matching cost (0..255)."""
JUMP_PENALTY: Final = 60.0
"""P2: neighbours further apart; divided by the step in brightness, because depth often jumps where brightness does."""
CONTRAST: Final = 10.0
"""Grey levels between neighbours that halve the jump penalty."""
BORDER: Final = 1e6
"""Cost of planes that do not exist; lies beside the first and the last plane of a path."""


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _advance(
    previous: NDArray[np.float32],
    lowest: np.float32,
    jump: np.float32,
    cost: NDArray[np.uint8],
    path: NDArray[np.float32],
) -> np.float32:
    """One pixel along a path: fills ``path`` (D + 2, with borders) from ``previous``, whose minimum is ``lowest``."""
    step = np.float32(STEP_PENALTY)
    ceiling = lowest + jump
    for plane in range(cost.size):
        beside = min(previous[plane], previous[plane + 2]) + step
        best = min(previous[plane + 1], beside, ceiling)
        path[plane + 1] = np.float32(np.int32(cost[plane])) + best - lowest
    return _smallest(path)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _smallest(values: NDArray[np.float32]) -> np.float32:
    smallest: np.float32 = values[0]
    for place in range(values.size):
        value = values[place]
        smallest = min(smallest, value)
    return smallest


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _jump_penalty(first: np.uint8, second: np.uint8) -> np.float32:
    contrast = abs(np.float32(first) - np.float32(second))
    return np.float32(JUMP_PENALTY) / (np.float32(1) + contrast / np.float32(CONTRAST))


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _sum_paths(total: NDArray[np.float32], along_row: NDArray[np.float32], along_column: NDArray[np.float32]) -> None:
    for plane in range(total.size):
        total[plane] = along_row[plane + 1] + along_column[plane + 1]


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _add_paths(total: NDArray[np.float32], along_row: NDArray[np.float32], along_column: NDArray[np.float32]) -> None:
    for plane in range(total.size):
        total[plane] += along_row[plane + 1] + along_column[plane + 1]


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _winner(total: NDArray[np.float32]) -> int:
    smallest = _smallest(total)
    plane = 0
    while total[plane] > smallest:
        plane += 1
    return plane


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _aggregate(
    costs: NDArray[np.uint8],
    image: NDArray[np.uint8],
    totals: NDArray[np.float32],
    rows: NDArray[np.float32],
    columns: NDArray[np.float32],
    column_lowest: NDArray[np.float32],
    plane_of: NDArray[np.float32],
    score: NDArray[np.float32],
) -> None:
    height, width, planes = costs.shape
    for backward in range(2):
        columns[:, 1 : planes + 1] = np.float32(0)
        column_lowest[:] = np.float32(0)
        for line in range(height):
            y = height - 1 - line if backward else line
            row_lowest = np.float32(0)
            rows[:, 1 : planes + 1] = np.float32(0)
            for place in range(width):
                x = width - 1 - place if backward else place
                before_x = min(max(x + 1 if backward else x - 1, 0), width - 1)
                before_y = min(max(y + 1 if backward else y - 1, 0), height - 1)
                cost = costs[y, x]
                along_row = rows[place % 2]
                along_column = columns[2 * x + line % 2]
                row_lowest = _advance(
                    rows[1 - place % 2], row_lowest, _jump_penalty(image[y, x], image[y, before_x]), cost, along_row
                )
                column_lowest[x] = _advance(
                    columns[2 * x + 1 - line % 2],
                    column_lowest[x],
                    _jump_penalty(image[y, x], image[before_y, x]),
                    cost,
                    along_column,
                )
                total = totals[y, x]
                if not backward:
                    _sum_paths(total, along_row, along_column)
                    continue
                _add_paths(total, along_row, along_column)
                best = _winner(total)
                plane_of[y, x] = np.float32(best)
                if 0 < best < planes - 1:
                    bend = total[best - 1] - np.float32(2) * total[best] + total[best + 1]
                    if bend > np.float32(0):
                        plane_of[y, x] += np.float32(0.5) * (total[best - 1] - total[best + 1]) / bend
                    score[y, x] = np.float32(1) - np.float32(cost[best]) / np.float32(255)
                else:
                    score[y, x] = np.float32(0)  # the true depth may lie beyond the planes


@dataclass(frozen=True, slots=True)
class Disparity:
    plane: NDArray[np.float32]
    """(H, W), fractional number of the winning plane."""
    score: NDArray[np.float32]
    """(H, W), correlation there in [0, 1]; 0 where the winner is the first or the last plane."""


class SemiGlobal:
    """The aggregation with its working memory, about 4 H W D bytes; one object per thread."""

    def __init__(self, width: int, height: int, planes: int) -> None:
        self._totals = np.zeros((height, width, planes), np.float32)
        self._rows = np.full((2, planes + 2), BORDER, np.float32)
        self._columns = np.full((2 * width, planes + 2), BORDER, np.float32)
        self._column_lowest = np.zeros(width, np.float32)

    def aggregate(self, costs: NDArray[np.uint8], image: NDArray[np.uint8]) -> Disparity:
        """``costs`` (H, W, D) as of `plane_sweep.PlaneSweep.costs`, ``image`` (H, W) grey, whose edges may be jumps."""
        plane = np.empty(image.shape, np.float32)
        score = np.empty(image.shape, np.float32)
        _aggregate(costs, image, self._totals, self._rows, self._columns, self._column_lowest, plane, score)
        return Disparity(plane, score)
