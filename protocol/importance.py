"""The importance index phi as one process holds it: decays with the team's states, jumps with map feedback."""

from __future__ import annotations

import copy
import hashlib
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol.field import VirtualField
from protocol.geometry import Floats
from protocol.mission import Sensing, Target
from protocol.sensing import decay_and_terms, owned_shares, raise_positions

SHARE_SAMPLES = 16_000
"""Cells looked at to estimate |V_i|; with them a share of the default field is off by at most 0.01 (tested)."""


@dataclass(frozen=True, slots=True)
class SamplingTerms:
    """What one drone's controller needs of the field, all sums over its own cells V_i at the start of the tick."""

    gradient: Floats
    """(5,) sum of (dh1/dp) phi, per metre and per radian."""
    first: float
    """Sum of h1 phi."""
    second: float
    """Sum of h1^2 phi."""


class ImportanceField:
    """phi of one replica, float32 [positions, directions], 1 everywhere at the start.

    J is kept by bookkeeping in float64: each tick's exact loss is subtracted, each jump's exact gain added.
    """

    def __init__(self, field: VirtualField, sensing: Sensing) -> None:
        self.field = field
        self.phi: NDArray[np.float32] = np.ones(field.shape, np.float32)
        self._start = 0
        self._sensing = sensing
        self._sigmas = (sensing.sigma_axis, sensing.sigma_view, sensing.sigma_distance_m)
        self._total = float(field.size)
        self._stride = max(1, math.ceil(field.size / SHARE_SAMPLES))
        while any(math.gcd(self._stride, len(axis)) > 1 for axis in (field.xs, field.ys, field.zs)):
            self._stride += 1

    @property
    def importance(self) -> float:
        """J of eq. (3)."""
        return self._total / self.field.size

    @property
    def sha256(self) -> str:
        return hashlib.sha256(self.phi.astype("<f4", copy=False).data).hexdigest()

    def advance(self, poses: Floats, dt: float, own: int = -1) -> SamplingTerms:
        """Decay by eq. (2) over ``dt`` seconds with poses (drones, 5) held; ``own`` is the row whose terms are wanted.

        Rows are ordered by drone id. The terms are those *before* the decay.
        """
        gradient, first, second, removed = decay_and_terms(
            self.phi,
            self._start,
            self.field.xs,
            self.field.ys,
            self.field.zs,
            self.field.directions,
            poses,
            own,
            self._sigmas,
            self._sensing.distance_m,
            self._sensing.exponent_cut,
            self._sensing.decay_per_s,
            dt,
        )
        self._total -= removed
        return SamplingTerms(gradient, first, second)

    def terms(self, poses: Floats, own: int) -> SamplingTerms:
        """The terms of drone ``own`` with poses (drones, 5), without any decay."""
        return self.advance(poses, 0.0, own)

    def overwrite(self, start: int, values: NDArray[np.float32]) -> None:
        """Set phi at the positions from ``start`` on to ``values`` (n, directions)."""
        rows = self.phi[start : start + len(values)]
        self._total += float(values.sum(dtype=np.float64) - rows.sum(dtype=np.float64))
        rows[:] = values

    def part(self, start: int, values: NDArray[np.float32]) -> ImportanceField:
        """The positions from ``start`` on alone, with ``values`` (n, directions) of their own that change by
        themselves. Costs what these positions cost; its importance is their part of J."""
        part = copy.copy(self)
        part.phi = np.array(values, np.float32, order="C")
        part._start = start  # noqa: SLF001  # of this class
        part._total = float(values.sum(dtype=np.float64))  # noqa: SLF001
        return part

    def jump(self, increments: NDArray[np.float32]) -> None:
        """Add ``increments`` (positions,), equal for all directions of a position: eq. (4) with delta_2 h2 given."""
        own = np.array(increments[self._start : self._start + len(self.phi)])  # numba has no kernel for read-only ones
        self._total += raise_positions(self.phi, own)

    def owned_cells(self, poses: Floats) -> Floats:
        """|V_i| of every drone, (drones,), estimated on a coarse lattice of at most some SHARE_SAMPLES cells."""
        field = self.field
        shares: Floats = owned_shares(
            field.xs, field.ys, field.zs, field.directions, poses, self._sigmas, self._sensing.distance_m, self._stride
        )
        return shares * field.size


def compile_kernels() -> None:
    """Let numba compile what a tick needs, or load it from its cache: once on a new machine it takes many seconds,
    which no process should spend while others wait for it."""
    field = ImportanceField(VirtualField.of(Target(cell_m=1.0, cell_rad=1.0)), Sensing())
    poses = np.array([[0.0, 0.0, 2.0, 0.0, 1.5], [0.5, 0.0, 2.0, 0.0, 1.5]])
    field.advance(poses, 0.05, 0)
    field.terms(poses, 0)
    field.owned_cells(poses)
    field.jump(np.zeros(field.phi.shape[0], np.float32))
