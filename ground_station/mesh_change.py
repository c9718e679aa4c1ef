"""Where the mesh still changes: the map feedback h2 that sends drones back, as vertex counts (Coverage-Recon, eq. (5)).

The evaluation points r_k are the centres of a uniform grid over B, and the field's positions are a lattice as
well. So the nearest r_k of a vertex is a rounding, and the Gaussian sum factorises into one small matrix per
axis: exact, and hundreds of times faster than the dense formula.
"""

from __future__ import annotations

from typing import Protocol, TypeAlias

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ground_station.reconstruction.reconstructor import Mesh
from protocol.errors import ReconstructionError
from protocol.field import cell_centres
from protocol.map_settings import Feedback
from protocol.mission import Box

Floats: TypeAlias = NDArray[np.float64]
Counts: TypeAlias = NDArray[np.int32]


class MeshChange(Protocol):
    """One kind of feedback. Used from one thread; the same meshes give the same bytes."""

    def update(self, mesh: Mesh) -> NDArray[np.float32]:
        """h2 at every position of the field, float32 (positions,), between the previous mesh and this one.

        Never negative, 0 everywhere if nothing changed; with ``feedback.normalisation`` "mean" at most 1. The first
        mesh is compared with an empty one, and what lies outside B is ignored. Raises ReconstructionError, and keeps
        the previous mesh, if an array has the wrong shape, a vertex is not finite or a face has no vertex.
        """
        ...


def checked(mesh: Mesh) -> Mesh:
    """``mesh``, if it is one; otherwise raises `ReconstructionError`."""
    vertices, faces = mesh.vertices, mesh.faces
    for name, array in (("vertices", vertices), ("faces", faces)):
        if array.ndim != 2 or array.shape[1] != 3:
            raise ReconstructionError(f"mesh change: {name} must be (N, 3), got {array.shape}")
    if not np.isfinite(vertices).all():
        raise ReconstructionError("mesh change: vertices are not finite")
    if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise ReconstructionError(f"mesh change: a face has a vertex that is none of the {len(vertices)}")
    return mesh


@njit(cache=True, nogil=True)
def count_vertices(vertices: NDArray[np.float32], lower: Floats, upper: Floats, shape: tuple[int, int, int]) -> Counts:
    """Number of vertices whose nearest cell centre is each of the grid's, int32 ``shape``.

    ``vertices`` is (V, 3), ``lower`` and ``upper`` (3,) are the corners of B, all in metres in the world frame.
    A vertex midway between two centres counts for the one with the larger coordinate (ties half up); surface
    extraction puts vertices on voxel edges, so ties are common. Vertices outside the closed box, NaN ones
    included, do not count.
    """
    counts = np.zeros(shape, np.int32)
    scale = np.empty(3)
    for axis in range(3):
        scale[axis] = shape[axis] / (upper[axis] - lower[axis])
    cell = np.empty(3, np.int64)
    for index in range(vertices.shape[0]):
        inside = True
        for axis in range(3):
            value = np.float64(vertices[index, axis])
            if not (lower[axis] <= value <= upper[axis]):
                inside = False
                break
            cell[axis] = min(int((value - lower[axis]) * scale[axis]), shape[axis] - 1)
        if inside:
            counts[cell[0], cell[1], cell[2]] += 1
    return counts


def gaussian_kernel(positions_m: Floats, grid_m: Floats, sigma_m: float, normalised: bool) -> Floats:
    """One axis of eq. (5)'s kernel, (positions, grid): exp(-(position - r)^2 / 2 sigma^2).

    ``normalised`` makes every row sum to one. The largest exponent of a row is taken out first, so that a
    kernel much narrower than the grid gives the nearest point's value and never 0/0.
    """
    exponent = -((positions_m[:, None] - grid_m[None, :]) ** 2) / (2 * sigma_m**2)
    if not normalised:
        return np.asarray(np.exp(exponent))
    weights = np.exp(exponent - exponent.max(axis=1, keepdims=True))
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


class GridMeshChange:
    """h2 of eq. (5) between consecutive meshes; it depends on a cell's position alone, not on its direction.
    Implements `MeshChange`.

    ``axes`` are the x, y and z coordinates of the field's position lattice (1-D, metres, world frame). Positions
    are ordered with x slowest: index = (ix * ny + iy) * nz + iz.

    The paper does not state the grid's spacing, and its sum is not normalised, so one update could raise the
    importance by far more than 1 (ARCHITECTURE.md, departure 6). ``feedback.normalisation`` "sum" is as printed;
    "mean" divides by the sum of the kernel's weights at that position, so h2 stays within [0, 1].
    """

    def __init__(self, target: Box, feedback: Feedback, axes: tuple[Floats, Floats, Floats]) -> None:
        self._lower = np.array(target.lower_m)
        self._upper = np.array(target.upper_m)
        grid = [
            cell_centres(low, high, feedback.spacing_m)
            for low, high in zip(target.lower_m, target.upper_m, strict=True)
        ]
        self._shape = (len(grid[0]), len(grid[1]), len(grid[2]))
        normalised = feedback.normalisation == "mean"
        self._kernels = tuple(
            gaussian_kernel(positions, points, feedback.kernel_m, normalised)
            for positions, points in zip(axes, grid, strict=True)
        )
        self._kappa = feedback.kappa
        self._counts: Counts = np.zeros(self._shape, np.int32)

    def update(self, mesh: Mesh) -> NDArray[np.float32]:
        vertices = np.ascontiguousarray(checked(mesh).vertices, np.float32)
        counts = count_vertices(vertices, self._lower, self._upper, self._shape)
        change = counts - self._counts
        self._counts = counts
        weight = np.tanh((change / self._kappa) ** 2) ** 2
        along_x, along_y, along_z = self._kernels
        spread = np.tensordot(along_x, weight, axes=(1, 0))  # x, grid y, grid z
        spread = np.tensordot(spread, along_y, axes=(1, 1))  # x, grid z, y
        spread = np.tensordot(spread, along_z, axes=(1, 1))  # x, y, z
        return spread.reshape(-1).astype(np.float32)
