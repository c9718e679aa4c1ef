"""A mesh of fewer triangles that still shows its colours, for pages that must stay small.

Vertices are merged by the cells of a grid (Rossignac and Borrel 1993). Unlike edge collapse it keeps as many vertices
on a flat wall as elsewhere, and it is the vertices that carry the colours.
"""

from __future__ import annotations

import math

import numpy as np

from ground_station.report.run_data import Mesh

COARSENING = 1.15
"""Of the cell, until the triangles are few enough."""


def coarse_mesh(mesh: Mesh, triangles: int) -> Mesh:
    """At most ``triangles`` of them; the mesh itself if it has no more. The same mesh gives the same bytes."""
    if len(mesh.faces) <= triangles:
        return mesh
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    area_m2 = float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum(dtype=np.float64)) / 2
    # Two triangles a cell, of what lies along the grid: the finest that can be enough.
    merged, cell_m = mesh, math.sqrt(2 * area_m2 / triangles)
    while len(merged.faces) > triangles:
        merged = _merged(mesh, cell_m)
        cell_m *= COARSENING
    return merged


def _merged(mesh: Mesh, cell_m: float) -> Mesh:
    """One vertex a cell, at the mean of those in it and with their mean colour; triangles that collapse vanish."""
    cells = np.floor((mesh.vertices - mesh.vertices.min(axis=0)) / cell_m).astype(np.int64)
    extent = cells.max(axis=0) + 1
    _, cluster = np.unique(np.ravel_multi_index(tuple(cells.T), tuple(extent)), return_inverse=True)
    counts = np.bincount(cluster)
    around = mesh.vertices.mean(axis=0, dtype=np.float64)
    both = np.column_stack([mesh.vertices - around, mesh.colours])
    means = np.stack([np.bincount(cluster, weights=column) / counts for column in both.T], axis=1)

    faces = cluster[mesh.faces].astype(np.int32)
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    vertices = (means[:, :3] + around).astype(np.float32)
    return Mesh(vertices, faces[np.sort(first)], np.round(means[:, 3:]).astype(np.uint8))
