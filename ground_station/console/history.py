"""Curves over a mission of any length in bounded memory: the longer it takes, the coarser they are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from protocol.geometry import Floats

CAPACITY: Final = 1000
"""Samples: more than a curve in a browser's side panel has pixels."""


class History:
    """Samples at least a period apart. When there are too many, every other one goes and the period doubles."""

    def __init__(self, columns: int, capacity: int = CAPACITY) -> None:
        """``columns``: values beside the time. ``capacity``: even, so that the halves fit."""
        if capacity < 2 or capacity % 2:
            raise ValueError(f"a capacity of {capacity} samples cannot be halved")
        self._rows = np.empty((capacity, 1 + columns))
        self._count = 0
        self._period_s = 0.0
        self._newest = np.full(1 + columns, -math.inf)

    def add(self, time_s: float, values: Sequence[float]) -> bool:
        """Whether it was taken: times ascend, and one that is not later than the newest is left out."""
        if not time_s > self._newest[0]:
            return False
        self._newest = np.array([time_s, *values])
        if self._count and time_s - self._rows[self._count - 1, 0] < self._period_s:
            return True
        if self._count == len(self._rows):
            self._halve()
        self._rows[self._count] = self._newest
        self._count += 1
        return True

    def _halve(self) -> None:
        kept = self._rows[: self._count : 2].copy()
        self._count = len(kept)
        self._rows[: self._count] = kept
        self._period_s = float(np.diff(kept[:, 0]).mean())

    @property
    def curves(self) -> tuple[Floats, ...]:
        """Times (n,), then each column (n,), capacity + 1 samples at most; the newest is always the last."""
        kept = self._rows[: self._count]
        if self._count and kept[-1, 0] < self._newest[0]:
            kept = np.vstack([kept, self._newest])
        return tuple(column.copy() for column in kept.T)
