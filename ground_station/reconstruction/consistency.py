"""A depth is believed where another view's depth map says the same: what is occluded or guessed differs there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ground_station.reconstruction.views import View

TOLERANCE: Final = 0.03
"""Relative difference of two depths that agree (measured best of 1, 2, 3, 5 %)."""


def agreements(
    reference: View, depth: NDArray[np.float32], others: Sequence[tuple[View, NDArray[np.float32]]]
) -> NDArray[np.uint8]:
    """(H, W): how many of ``others`` see the same surface as ``depth`` (H, W) m, 0 where unknown, of ``reference``."""
    count = np.zeros(depth.shape, np.uint8)
    inverse = np.linalg.inv(reference.calibration)
    for view, other_depth in others:
        to_other = view.calibration @ view.rotation.T
        turn = (to_other @ reference.rotation @ inverse).astype(np.float32)
        shift = (to_other @ (reference.position - view.position)).astype(np.float32)
        _count_agreements(depth, other_depth, turn, shift, count)
    return count


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _count_agreements(
    depth: NDArray[np.float32],
    other_depth: NDArray[np.float32],
    turn: NDArray[np.float32],
    shift: NDArray[np.float32],
    count: NDArray[np.uint8],
) -> None:
    height, width = depth.shape
    rows, columns = other_depth.shape
    for y in range(height):
        for x in range(width):
            here = depth[y, x]
            if here <= np.float32(0):
                continue
            across, down = np.float32(x), np.float32(y)
            expected = here * (turn[2, 0] * across + turn[2, 1] * down + turn[2, 2]) + shift[2]
            if expected <= np.float32(0):
                continue
            u = (here * (turn[0, 0] * across + turn[0, 1] * down + turn[0, 2]) + shift[0]) / expected
            v = (here * (turn[1, 0] * across + turn[1, 1] * down + turn[1, 2]) + shift[1]) / expected
            if u < np.float32(-0.5) or v < np.float32(-0.5):
                continue
            column, row = int(u + np.float32(0.5)), int(v + np.float32(0.5))
            if column >= columns or row >= rows:
                continue
            found = other_depth[row, column]
            if abs(found - expected) < np.float32(TOLERANCE) * expected:
                count[y, x] += np.uint8(1)
