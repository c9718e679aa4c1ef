"""Rows of a reference image, seen at one depth, fetched from the images of its sources.

The work is cut into loops that each write few small rows, because only then does LLVM turn them into vector code: a
load at a computed index and a store in one loop already forbid it. Where they can, they run over the
rows of all sources at once, and arrays are passed whole: a call or a view costs as much as a dozen pixels.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def pack_neighbours(image: NDArray[np.uint8], packed: NDArray[np.uint32]) -> None:
    """Each pixel with its right, lower and lower-right neighbour as the bytes of one integer.

    Bilinear interpolation then needs one load instead of four. The last row and column are not meant to be read.
    """
    height, width = image.shape
    for y in range(height - 1):
        for x in range(width - 1):
            packed[y, x] = (
                np.uint32(image[y, x])
                | np.uint32(image[y, x + 1]) << np.uint32(8)
                | np.uint32(image[y + 1, x]) << np.uint32(16)
                | np.uint32(image[y + 1, x + 1]) << np.uint32(24)
            )


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def locate_row(
    turns: NDArray[np.float32],
    shifts: NDArray[np.float32],
    source: int,
    y: int,
    inverse_depth: np.float32,
    height: int,
    width: int,
    index: NDArray[np.int32],
    across: NDArray[np.float32],
    down: NDArray[np.float32],
    inside: NDArray[np.float32],
    slot: int,
) -> None:
    """Where row ``y`` of the reference falls in one source, by `plane_sweep.plane_homography`.

    Writes row ``source`` of ``index``, the packed pixel, of ``across`` and ``down``, the fractions from it, and of
    ``inside[slot]``, whether the source sees the place at all (1 or 0).
    """
    zero, one, behind = np.float32(0), np.float32(1), np.float32(1e-6)
    right, bottom = np.float32(width - 1.001), np.float32(height - 1.001)  # a packed pixel reaches one further
    pitch, image = np.float32(width), np.int32(source * height * width)
    line = np.float32(y)
    step_u, step_v, step_w = turns[source, 0, 0], turns[source, 1, 0], turns[source, 2, 0]
    start_u = turns[source, 0, 1] * line + turns[source, 0, 2] + shifts[source, 0] * inverse_depth
    start_v = turns[source, 1, 1] * line + turns[source, 1, 2] + shifts[source, 1] * inverse_depth
    start_w = turns[source, 2, 1] * line + turns[source, 2, 2] + shifts[source, 2] * inverse_depth
    for x in range(width):
        along = np.float32(np.int32(x))
        scale = start_w + step_w * along
        inverse = one / max(scale, behind)
        u = (start_u + step_u * along) * inverse
        v = (start_v + step_v * along) * inverse
        clamped_u = min(max(u, zero), right)
        clamped_v = min(max(v, zero), bottom)
        column = np.float32(np.int32(clamped_u))
        row = np.float32(np.int32(clamped_v))
        index[source, x] = np.int32(row * pitch + column) + image
        across[source, x] = clamped_u - column
        down[source, x] = clamped_v - row
        inside[slot, source, x] = one if clamped_u == u and clamped_v == v and scale > behind else zero


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def gather_row(packed: NDArray[np.uint32], index: NDArray[np.int32], gathered: NDArray[np.uint32]) -> None:
    for x in range(gathered.size):
        gathered[x] = packed[np.uint32(index[x])]


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def interpolate_row(
    gathered: NDArray[np.uint32],
    across: NDArray[np.float32],
    down: NDArray[np.float32],
    warped: NDArray[np.float32],
) -> None:
    """Bilinear; 128 less than the grey level, because small values keep running sums exact."""
    byte = np.uint32(255)
    for x in range(gathered.size):
        four = gathered[x]
        upper_left = np.float32(np.int32(four & byte))
        upper_right = np.float32(np.int32((four >> np.uint32(8)) & byte))
        lower_left = np.float32(np.int32((four >> np.uint32(16)) & byte))
        lower_right = np.float32(np.int32(four >> np.uint32(24)))
        upper = upper_left + across[x] * (upper_right - upper_left)
        lower = lower_left + across[x] * (lower_right - lower_left)
        warped[x] = upper + down[x] * (lower - upper) - np.float32(128)
