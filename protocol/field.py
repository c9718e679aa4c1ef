"""The virtual field: a regular lattice of positions times a table of directions to see them from.

The paper's 5-D cells q_j = (x, y, z, yaw, pitch) factor into positions and directions, so nothing is stored
per cell but its importance: ``phi[position, direction]``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from protocol.geometry import Floats
from protocol.mission import Target


def cell_centres(low: float, high: float, wished: float) -> Floats:
    """Centres (cells,) of the equal cells of [low, high] whose edge is nearest to ``wished``, at least one; see
    ARCHITECTURE.md, departure 4."""
    count = max(1, round((high - low) / wished))
    edge = (high - low) / count
    return low + edge * (np.arange(count, dtype=np.float64) + 0.5)


@dataclass(frozen=True, slots=True)
class VirtualField:
    """Positions are ordered with x slowest and z fastest; directions with yaw slowest and pitch fastest."""

    xs: Floats
    """(nx,) cell centres in metres, ascending, evenly spaced; likewise ``ys`` and ``zs``."""
    ys: Floats
    zs: Floats
    directions: Floats
    """(directions, 3) unit vectors Dir(q), from the cell towards where the camera should be."""

    @classmethod
    def of(cls, target: Target) -> Self:
        xs, ys, zs = (
            cell_centres(low, high, target.cell_m) for low, high in zip(target.lower_m, target.upper_m, strict=True)
        )
        yaws = cell_centres(*target.yaw_rad, target.cell_rad)
        pitches = cell_centres(*target.pitch_rad, target.cell_rad)
        yaw, pitch = (grid.ravel() for grid in np.meshgrid(yaws, pitches, indexing="ij"))
        directions = np.column_stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
        return cls(xs, ys, zs, np.ascontiguousarray(directions))

    @property
    def shape(self) -> tuple[int, int]:
        """(positions, directions)."""
        return len(self.xs) * len(self.ys) * len(self.zs), len(self.directions)

    @property
    def size(self) -> int:
        """m, the number of cells."""
        positions, directions = self.shape
        return positions * directions

    def positions(self) -> Floats:
        """(positions, 3) all cell positions; for tests, pictures and export, not for the control loop."""
        grid = np.meshgrid(self.xs, self.ys, self.zs, indexing="ij")
        return np.stack([axis.ravel() for axis in grid], axis=1)
