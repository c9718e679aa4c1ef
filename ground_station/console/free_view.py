"""What drones take for free, at one height: a cut through the cells, and what of them is nearest to a drone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from protocol.geometry import Floats
from protocol.messages import FreeCells
from protocol.mission import Mission
from protocol.obstacle_grid import Cells, ObstacleGrid

NEAR_M: Final = 2.0
"""Farther away nothing is in a drone's way."""


@dataclass(frozen=True, slots=True, eq=False)
class Cut:
    height_m: float
    """Of the middle of its cells."""
    free: Cells
    """[x, y]"""
    borders: NDArray[np.float32]
    """(n, 2, 3) m, world: edges between what is free and what is not."""


@dataclass(frozen=True, slots=True, eq=False)
class Nearest:
    """The cell that is not free and nearest to a place."""

    point: Floats
    """(3,) m: of the cell, nearest to the place."""
    low: Floats
    """(3,) m: its lowest corner."""
    distance_m: float


class FreeView:
    """Of a mission with obstacles; until a map comes, what the mission vouches for, as drones take it."""

    def __init__(self, mission: Mission) -> None:
        self.grid = ObstacleGrid.of(mission)
        self._message: FreeCells | None = None
        self._free = self.grid.vouched

    def take(self, message: FreeCells | None) -> bool:
        """Whether cells have become free or have ceased to be. Raises `MessageError` for what is not this lattice's."""
        if message is None or message is self._message:
            return False
        self._message = message
        free = self.grid.read(message)
        changed = not np.array_equal(free, self._free)
        self._free = free
        return changed

    def level(self, height_m: float) -> int:
        """Of the layer of cells that ``height_m`` lies in: 0 is the lowest, below it nothing is drawn; the uppermost is
        one above the lattice, where all is free."""
        level = int(np.floor((height_m - self.grid.origin[2]) / self.grid.cell_m))
        return min(max(level, 0), self.grid.shape[2])

    def cut(self, level: int) -> Cut:
        grid = self.grid
        free = self._free[:, :, level] if level < grid.shape[2] else np.ones(grid.shape[:2], np.bool_)
        height_m = float(grid.origin[2] + grid.cell_m * (level + 0.5))
        return Cut(height_m, free, self._borders(free, height_m))

    def _borders(self, free: Cells, height_m: float) -> NDArray[np.float32]:
        segments = []
        for axis in (0, 1):
            behind = np.argwhere(np.diff(free, axis=axis)) + np.eye(2, dtype=int)[axis]
            along = np.eye(2, dtype=int)[1 - axis]
            segments.append(np.stack([behind, behind + along], axis=1))
        ends = np.concatenate(segments) * self.grid.cell_m + self.grid.origin[:2]
        return np.concatenate([ends, np.full((*ends.shape[:2], 1), height_m)], axis=2).astype(np.float32)

    def nearest(self, place: Floats) -> Nearest | None:
        """To ``place`` (3,); None if nothing within `NEAR_M` is not free."""
        grid, cell = self.grid, self.grid.cell_m
        own = (place - grid.origin) / cell
        reach = NEAR_M / cell
        first = np.clip(np.floor(own - reach), 0, grid.shape).astype(int)
        behind = np.clip(np.ceil(own + reach), 0, grid.shape).astype(int)
        blocked = np.argwhere(~self._free[tuple(map(slice, first, behind))]) + first
        if not len(blocked):
            return None
        points = np.clip(own, blocked, blocked + 1)
        squares = ((points - own) ** 2).sum(axis=1)
        chosen = int(squares.argmin())
        distance_m = float(np.sqrt(squares[chosen])) * cell
        if distance_m > NEAR_M:
            return None
        return Nearest(grid.origin + cell * points[chosen], grid.origin + cell * blocked[chosen], distance_m)
