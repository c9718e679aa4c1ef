"""phi in blocks of positions: what replicas compare, fetch and repair at a time.

A block's sketch is its mean and three random projections (Alon, Matias and Szegedy, 1999): every cell counts with a
sign that a hash of its place gives. Of two blocks whose cells differ by e, the projections differ by a random number
with variance mean(e^2): so a few floats tell the root mean square difference, also where the means agree.
"""

from __future__ import annotations

import math
from itertools import pairwise, starmap

import numpy as np
from numpy.typing import NDArray

from protocol.geometry import Floats

BLOCK_POSITIONS = 32
"""Positions of a block; with 42 directions 5 kB, with the 208 of the paper's large field 27 kB."""
PAGE_BYTES = 30_000
"""Of phi in one reply. Replies of up to 30 kB came through links of 30 kB/s and more; those that zenoh has to cut,
above 65,535 bytes, did not."""
SKETCHES = 4
"""Floats of one block's sketch: its mean, then the signed sums."""
PART_CELLS = 2**20
"""Of phi sketched in one tick: 1.5 ms. All 1.5e7 cells of the paper's large field would take half a tick."""
PART_BYTES = 30_000
"""Of sketches in one digest: like a page's."""


class BlockLayout:
    """Contiguous runs of positions; the last block may be shorter."""

    def __init__(self, shape: tuple[int, int]) -> None:
        """``shape``: positions, directions."""
        self.positions, self.directions = shape
        self.count = -(-self.positions // BLOCK_POSITIONS)
        starts = np.arange(self.count) * BLOCK_POSITIONS
        cells = np.diff(np.append(starts, self.positions)) * self.directions
        self._scale = 1.0 / np.column_stack([cells, *[np.sqrt(cells)] * (SKETCHES - 1)])
        sketched = self.positions * self.directions / PART_CELLS, self.count * SKETCHES * 4 / PART_BYTES
        parts = min(self.count, max(1, math.ceil(max(sketched))))
        ends = [self.count * part // parts for part in range(parts + 1)]
        self.parts = tuple(starmap(range, pairwise(ends)))
        """Blocks that are sketched at once; all of them in a small field."""

    def rows(self, block: int) -> slice:
        """Its positions."""
        return slice(block * BLOCK_POSITIONS, min((block + 1) * BLOCK_POSITIONS, self.positions))

    def rows_of(self, blocks: NDArray[np.int32]) -> NDArray[np.int64]:
        """Positions of ``blocks`` (n,), one block after the other."""
        if not blocks.size:
            return np.empty(0, np.int64)
        return np.concatenate([np.arange(rows.start, rows.stop) for rows in map(self.rows, blocks.tolist())])

    def blocks_a_page(self) -> int:
        return max(1, PAGE_BYTES // (BLOCK_POSITIONS * self.directions * 4))

    def parts_due(self, tick: int, period: int) -> list[range]:
        """Those to sketch when all ticks before ``tick`` are in: each once in ``period`` ticks, spread evenly."""
        return [part for number, part in enumerate(self.parts) if number * period // len(self.parts) == tick % period]

    def sketch(self, phi: NDArray[np.float32], tick: int, blocks: range | None = None) -> NDArray[np.float32]:
        """(blocks, SKETCHES) of phi (positions, directions), of all ``blocks`` if None; at one tick equal bytes give
        equal sketches.

        Every tick has its own signs: a difference that one projection hides, another soon shows.
        """
        blocks = range(self.count) if blocks is None else blocks
        rows = slice(self.rows(blocks.start).start, self.rows(blocks.stop - 1).stop)
        column_signs = _signs(0, self.directions, salt=2 * tick + 1).astype(np.float32)
        by_position = (phi[rows] @ column_signs).astype(np.float64) * _signs(rows.start, rows.stop, salt=2 * tick)
        sums = np.add.reduceat(by_position, np.arange(len(blocks)) * BLOCK_POSITIONS, axis=0)
        return (sums * self._scale[blocks.start : blocks.stop]).astype(np.float32)

    def differing(self, one: NDArray[np.float32], other: NDArray[np.float32], tolerance: float) -> list[int]:
        """Blocks whose cells differ by more than about ``tolerance``, root mean square."""
        apart = np.abs(one.astype(np.float64) - other).max(axis=1)
        return [int(block) for block in np.flatnonzero(apart > tolerance)]


def _signs(first: int, end: int, salt: int) -> Floats:
    """(end - first, SKETCHES) of the places from ``first`` on: ones for the mean, then +-1 from the bits of a hash
    (splitmix64; Steele et al., 2014)."""
    state = (np.arange(first, end, dtype=np.uint64) + np.uint64(salt << 32)) * np.uint64(0x9E3779B97F4A7C15)
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    state ^= state >> np.uint64(31)
    bits = [(state >> np.uint64(k)) & np.uint64(1) for k in range(1, SKETCHES)]
    return np.column_stack([np.ones(end - first), *[1.0 - 2.0 * bit for bit in bits]])
