"""Depth hypotheses of one keyframe: how well its neighbours' images agree with it at each of many depths.

Plane sweep (Collins, "A space-sweep approach to true multi-image matching", 1996) with zero-mean normalised
cross-correlation in square windows. Sums over windows are running sums; see `warp` for why the loops are cut small.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ground_station.reconstruction.views import View
from ground_station.reconstruction.warp import gather_row, interpolate_row, locate_row, pack_neighbours
from protocol.geometry import Floats

RADIUS: Final = 2
"""The window is 5 x 5 pixels: larger ones blur edges, smaller ones match noise."""
WINDOW: Final = 2 * RADIUS + 1
PIXELS: Final = WINDOW * WINDOW
NOISE_VARIANCE: Final = 2.0
"""Added to both variances, grey levels squared: what the camera's noise leaves after shrinking to the sweep's size.
Keeps the score of a textureless window near zero instead of correlating noise."""
UNSEEN: Final = 2.0
"""Stands for the score of a pixel that a source does not see; larger than any score."""
COST_MAX: Final = 255
"""Cost of a score <= 0 and of a depth that no source sees; a perfect score costs 0."""


class PlaneSweep:
    """The sweep with its working memory, about H W (12 + 4 S + D) bytes; one object per thread.

    ``width`` and ``height`` are those of every view, ``sources`` and ``planes`` upper bounds for a call.
    """

    def __init__(self, width: int, height: int, sources: int, planes: int) -> None:
        self._reference = np.zeros((height, width), np.float32)
        self._window_sum = np.zeros((height, width), np.float32)
        self._window_scale = np.zeros((height, width), np.float32)
        self._packed = np.zeros((sources, height, width), np.uint32)
        self._costs = np.full((height, width, planes), COST_MAX, np.uint8)

    def costs(self, reference: View, sources: Sequence[View], inverse_depths: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Matching cost (H, W, D), 0 best and `COST_MAX` worst, valid until the next call.

        ``inverse_depths`` (D,) 1/m, along the reference's optical axis. The outer `RADIUS` pixels have no window
        and keep the worst cost everywhere.
        """
        np.subtract(reference.grey, np.float32(128), out=self._reference)
        _window_statistics(self._reference, self._window_sum, self._window_scale)
        turns = np.empty((len(sources), 3, 3), np.float32)
        shifts = np.empty((len(sources), 3), np.float32)
        for number, source in enumerate(sources):
            pack_neighbours(source.grey, self._packed[number])
            turns[number], shifts[number] = plane_homography(reference, source)
        costs = self._costs[:, :, : inverse_depths.size]
        _sweep(
            self._reference,
            self._window_sum,
            self._window_scale,
            self._packed.reshape(-1),
            turns,
            shifts,
            inverse_depths,
            costs,
        )
        return costs


def plane_homography(reference: View, source: View) -> tuple[Floats, Floats]:
    """``turn`` (3, 3) and ``shift`` (3,) that take a pixel of the reference, at inverse depth w, into the source.

    The pixel of index (x, y) falls on the homogeneous index ``turn @ [x, y, 1] + w * shift``: Hartley and Zisserman,
    "Multiple view geometry", 2004, eq. (13.2), for planes parallel to the reference's image. Indices are half a
    pixel less than coordinates (`protocol.geometry`).
    """
    to_source = source.rotation.T @ reference.rotation
    translation = source.rotation.T @ (reference.position - source.position)
    turn = source.calibration @ to_source @ np.linalg.inv(reference.calibration)
    return turn, source.calibration @ translation


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _window_statistics(
    image: NDArray[np.float32], window_sum: NDArray[np.float32], window_scale: NDArray[np.float32]
) -> None:
    """Sum and inverse spread of each whole window, stored at the column where the window begins."""
    height, width = image.shape
    count, noise = np.float32(PIXELS), np.float32(NOISE_VARIANCE * PIXELS * PIXELS)
    sums, squares = np.zeros(width, np.float32), np.zeros(width, np.float32)
    for y in range(RADIUS, height - RADIUS):
        sums[:] = np.float32(0)
        squares[:] = np.float32(0)
        for row in range(y - RADIUS, y + RADIUS + 1):
            for x in range(width):
                sums[x] += image[row, x]
                squares[x] += image[row, x] * image[row, x]
        for x in range(width - 2 * RADIUS):
            total = sums[x] + sums[x + 1] + sums[x + 2] + sums[x + 3] + sums[x + 4]
            square = squares[x] + squares[x + 1] + squares[x + 2] + squares[x + 3] + squares[x + 4]
            window_sum[y, x] = total
            window_scale[y, x] = np.float32(1) / np.sqrt(max(count * square - total * total, np.float32(0)) + noise)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _sweep(
    reference: NDArray[np.float32],
    window_sum: NDArray[np.float32],
    window_scale: NDArray[np.float32],
    packed: NDArray[np.uint32],
    turns: NDArray[np.float32],
    shifts: NDArray[np.float32],
    inverse_depths: NDArray[np.float32],
    costs: NDArray[np.uint8],
) -> None:
    height, width = reference.shape
    sources = turns.shape[0]
    inner = width - 2 * RADIUS
    index, gathered = np.empty((sources, width), np.int32), np.empty((sources, width), np.uint32)
    across, down = np.empty((sources, width), np.float32), np.empty((sources, width), np.float32)
    fresh, products = np.empty((sources, width), np.float32), np.empty((sources, width), np.float32)
    sums, squares = np.empty((sources, width), np.float32), np.empty((sources, width), np.float32)
    warped, inside = np.empty((WINDOW, sources, width), np.float32), np.empty((WINDOW, sources, width), np.float32)
    score, cost = np.empty(inner, np.float32), np.empty(inner, np.uint8)
    total, seen, worst = np.empty(inner, np.float32), np.empty(inner, np.float32), np.empty(inner, np.float32)
    # The same memory, the rows of all sources as one.
    all_index, all_gathered, all_across, all_down = index.ravel(), gathered.ravel(), across.ravel(), down.ravel()
    all_fresh, all_sums, all_squares = fresh.ravel(), sums.ravel(), squares.ravel()
    all_warped = warped.reshape((WINDOW, sources * width))
    for plane in range(inverse_depths.size):
        sums[:] = np.float32(0)
        squares[:] = np.float32(0)
        products[:] = np.float32(0)
        warped[:] = np.float32(0)
        for y in range(height):
            slot = y % WINDOW
            for source in range(sources):
                locate_row(
                    turns, shifts, source, y, inverse_depths[plane], height, width, index, across, down, inside, slot
                )
            gather_row(packed, all_index, all_gathered)
            interpolate_row(all_gathered, all_across, all_down, all_fresh)
            _slide(all_fresh, all_warped, slot, all_sums, all_squares)
            for source in range(sources):
                _slide_products(reference, y, fresh, warped, slot, source, products)
            _keep(all_fresh, all_warped, slot)
            centre = y - RADIUS  # of the window whose last row this is
            if centre < RADIUS:
                continue
            total[:] = np.float32(0)
            seen[:] = np.float32(0)
            worst[:] = np.float32(UNSEEN)
            for source in range(sources):
                _score_row(
                    sums, squares, products, source, window_sum, window_scale, centre, inside, centre % WINDOW, score
                )
                _tally(score, total, seen, worst)
            _rate(total, seen, worst, cost)
            for x in range(inner):
                costs[centre, x + RADIUS, plane] = cost[x]


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _slide(
    fresh: NDArray[np.float32],
    warped: NDArray[np.float32],
    slot: int,
    sums: NDArray[np.float32],
    squares: NDArray[np.float32],
) -> None:
    """Column sums over the last `WINDOW` rows: ``fresh`` enters, row ``slot`` of the ring ``warped`` leaves."""
    for x in range(fresh.size):
        entering, leaving = fresh[x], warped[slot, x]
        sums[x] += entering - leaving
        squares[x] += entering * entering - leaving * leaving


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _slide_products(
    reference: NDArray[np.float32],
    y: int,
    fresh: NDArray[np.float32],
    warped: NDArray[np.float32],
    slot: int,
    source: int,
    products: NDArray[np.float32],
) -> None:
    """The same for the products of one source with the reference."""
    before = max(y - WINDOW, 0)  # while the ring fills up, what leaves is 0
    for x in range(reference.shape[1]):
        entering = fresh[source, x] * reference[y, x]
        products[source, x] += entering - warped[slot, source, x] * reference[before, x]


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _keep(fresh: NDArray[np.float32], warped: NDArray[np.float32], slot: int) -> None:
    for x in range(fresh.size):
        warped[slot, x] = fresh[x]


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _score_row(
    sums: NDArray[np.float32],
    squares: NDArray[np.float32],
    products: NDArray[np.float32],
    source: int,
    window_sum: NDArray[np.float32],
    window_scale: NDArray[np.float32],
    centre: int,
    inside: NDArray[np.float32],
    slot: int,
    score: NDArray[np.float32],
) -> None:
    """Correlation of each window around row ``centre`` with one source, from the column sums."""
    count, noise = np.float32(PIXELS), np.float32(NOISE_VARIANCE * PIXELS * PIXELS)
    for x in range(score.size):
        total, square, product = np.float32(0), np.float32(0), np.float32(0)
        for column in range(WINDOW):
            total += sums[source, x + column]
            square += squares[source, x + column]
            product += products[source, x + column]
        variance = max(count * square - total * total, np.float32(0)) + noise
        covariance = count * product - window_sum[centre, x] * total
        value = covariance * window_scale[centre, x] / np.sqrt(variance)
        score[x] = value if inside[slot, source, x + RADIUS] > np.float32(0) else np.float32(UNSEEN)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _tally(
    score: NDArray[np.float32], total: NDArray[np.float32], seen: NDArray[np.float32], worst: NDArray[np.float32]
) -> None:
    for x in range(score.size):
        value = score[x]
        visible = value < np.float32(UNSEEN)
        total[x] += value if visible else np.float32(0)
        seen[x] += np.float32(1) if visible else np.float32(0)
        worst[x] = min(worst[x], value)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _rate(
    total: NDArray[np.float32], seen: NDArray[np.float32], worst: NDArray[np.float32], cost: NDArray[np.uint8]
) -> None:
    """Cost of the mean score, without the worst source where three or more see the pixel: it may be occluded."""
    zero, one, highest = np.float32(0), np.float32(1), np.float32(COST_MAX)
    for x in range(cost.size):
        drop = seen[x] > np.float32(2.5)
        kept = total[x] - (worst[x] if drop else zero)
        count = seen[x] - (one if drop else zero)
        mean = max(kept / max(count, one), zero)
        cost[x] = np.uint8(np.int32(min(highest * (one - mean) + np.float32(0.5), highest)))
