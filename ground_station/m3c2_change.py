"""How far the mesh still moves: the map feedback h2 by displacements of the surface (Coverage-Recon, eq. (6))."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ground_station.m3c2 import Cloud, Lattice, changed_cells, core_points, displacements
from ground_station.mesh_change import checked
from ground_station.reconstruction.reconstructor import Mesh
from protocol.geometry import Floats
from protocol.map_settings import Cylinder, Feedback
from protocol.mission import Box


class M3C2MeshChange:
    """h2 of eq. (6) between consecutive meshes. Implements `mesh_change.MeshChange`.

    Printed is h2 = sum_k L(r_k) exp(-|Pos(q) - r_k|^2 / 2 sigma_4^2) over "uniformly spaced core points", with
    L >= 0 "the average perpendicular distance between the two point clouds in the local neighbourhood" of r_k. Neither
    the core points nor the neighbourhood are stated, nor what L is where one cloud has no points. Taken is:

    - a core point in every cell of ``feedback.spacing_m`` that holds surface, of the newer mesh where that has any;
    - the normal there of that mesh;
    - |L| of M3C2 in ``feedback.cylinder``, at most its half length;
    - the half length where one mesh alone has surface in the cylinder: it moved at least so far, for all that can be
      measured. M3C2 itself gives NaN there, and the map would grow without being looked at again.

    L is 0 where the vertices in the cylinder are the same, so only core points near cells with other vertices are
    measured.

    ``feedback.normalisation`` "sum" is as printed, in metres. "mean" takes L as a share of the half length, divides by
    the weight that core points on a plane through the position would have, 2 pi sigma_4^2 / spacing^2, and stops at 1.
    So it does not depend on the spacing, and a new surface counts as it does by eq. (5).
    """

    def __init__(self, target: Box, feedback: Feedback, axes: tuple[Floats, Floats, Floats]) -> None:
        """``axes`` as in `mesh_change.GridMeshChange`."""
        self._lattice = Lattice.over(target, feedback.spacing_m)
        self._cylinder = feedback.cylinder
        self._axes, self._sigma = axes, feedback.kernel_m
        self._normalised = feedback.normalisation == "mean"
        on_a_plane = 2 * math.pi * feedback.kernel_m**2 / float(np.prod(self._lattice.edges)) ** (2 / 3)
        self._largest = on_a_plane * self._cylinder.half_length_m
        self._before = Cloud.of(Mesh.empty(), self._lattice)

    def update(self, mesh: Mesh) -> NDArray[np.float32]:
        after = Cloud.of(checked(mesh), self._lattice)
        before, self._before = self._before, after
        cores, normals = core_points(before, after)
        lengths = surface_change(cores, normals, (before, after), self._lattice, self._cylinder)
        moved = lengths > 0
        h2 = _spread(cores[moved], lengths[moved], *self._axes, self._sigma)
        if self._normalised:
            h2 = np.minimum(h2 / self._largest, 1.0)
        return h2.astype(np.float32)


def surface_change(
    cores: Floats, normals: Floats, clouds: tuple[Cloud, Cloud], lattice: Lattice, cylinder: Cylinder
) -> Floats:
    """L (K,) in metres, within 0 and the cylinder's half length."""
    farthest = cylinder.half_length_m
    distances, counts = displacements(
        cores, normals, clouds, lattice, cylinder.radius_m, farthest, changed_cells(*clouds)
    )
    present = counts >= cylinder.points_min
    lengths = np.where(present.all(axis=1), np.minimum(np.abs(distances), farthest), 0.0)
    lengths[present[:, 0] != present[:, 1]] = farthest
    return lengths


@njit(cache=True, nogil=True)
def _spread(points: Floats, weights: Floats, xs: Floats, ys: Floats, zs: Floats, sigma: float) -> Floats:
    """(positions,), x slowest: the sum of ``weights`` (K,) at ``points`` (K, 3), each times its Gaussian.

    A Gaussian is the product of one along each axis, so a point takes as many exponentials as the axes are long.
    """
    spread = np.zeros((xs.size, ys.size * zs.size))
    along_x, along_y, along_z = np.empty(xs.size), np.empty(ys.size), np.empty(zs.size)
    layer = np.empty(ys.size * zs.size)
    for k in range(points.shape[0]):
        for axis, positions, along in ((0, xs, along_x), (1, ys, along_y), (2, zs, along_z)):
            for place in range(positions.size):
                along[place] = np.exp(-((positions[place] - points[k, axis]) ** 2) / (2 * sigma**2))
        for y in range(ys.size):
            for z in range(zs.size):
                layer[y * zs.size + z] = along_y[y] * along_z[z]
        for x in range(xs.size):
            factor = weights[k] * along_x[x]
            for place in range(layer.size):
                spread[x, place] += factor * layer[place]
    return spread.ravel()
