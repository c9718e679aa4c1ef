"""Exact distance of a point from a triangle: what F-scores are judged by, and a simulated vehicle's contacts."""

from __future__ import annotations

from typing import Any

from numba import njit
from numpy.typing import NDArray

Array = NDArray[Any]
"""Of float32 or float64."""


@njit(cache=True, nogil=True, inline="always")
def squared_distance(point: Array, corner: Array) -> float:
    """From a point (3,) to a triangle, the rows of ``corner`` (3, 3); an edge or a corner if it has no area."""
    abx, aby, abz = corner[1, 0] - corner[0, 0], corner[1, 1] - corner[0, 1], corner[1, 2] - corner[0, 2]
    acx, acy, acz = corner[2, 0] - corner[0, 0], corner[2, 1] - corner[0, 1], corner[2, 2] - corner[0, 2]
    px, py, pz = point[0] - corner[0, 0], point[1] - corner[0, 1], point[2] - corner[0, 2]
    # Gram matrix of the two edges and the projections of the point on them.
    bb, bc, cc = abx * abx + aby * aby + abz * abz, abx * acx + aby * acy + abz * acz, acx * acx + acy * acy + acz * acz
    d1, d2 = abx * px + aby * py + abz * pz, acx * px + acy * py + acz * pz
    determinant = bb * cc - bc * bc
    v, w = d1 * cc - d2 * bc, d2 * bb - d1 * bc
    if determinant > 0 and v >= 0 and w >= 0 and v + w <= determinant:
        v, w = v / determinant, w / determinant
    else:
        v, w = _nearest_on_edges(bb, bc, cc, d1, d2)
    x, y, z = px - v * abx - w * acx, py - v * aby - w * acy, pz - v * abz - w * acz
    return float(x * x + y * y + z * z)


@njit(cache=True, nogil=True, inline="always")
def _nearest_on_edges(bb: float, bc: float, cc: float, d1: float, d2: float) -> tuple[float, float]:
    """Weights (v, w) of the second and third corner that minimise |p - v AB - w AC|^2 on the triangle's edges."""
    v, w = min(max(d1 / bb, 0.0), 1.0) if bb > 0 else 0.0, 0.0
    least = v * v * bb - 2 * v * d1
    along = min(max(d2 / cc, 0.0), 1.0) if cc > 0 else 0.0
    cost = along * along * cc - 2 * along * d2
    if cost < least:
        v, w, least = 0.0, along, cost
    opposite = bb - 2 * bc + cc
    along = min(max((bb - bc - d1 + d2) / opposite, 0.0), 1.0) if opposite > 0 else 0.0
    cost = (1 - along) ** 2 * bb + 2 * (1 - along) * along * bc + along**2 * cc - 2 * ((1 - along) * d1 + along * d2)
    if cost < least:
        v, w = 1 - along, along
    return v, w
