"""Writes coloured triangles as a binary PLY file, which every mesh viewer opens."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from protocol.geometry import Floats

_VERTEX = np.dtype([("position", "<f4", 3), ("colour", "u1", 3)])
_FACE = np.dtype([("count", "u1"), ("vertices", "<i4", 3)])


def write_ply(path: Path, triangles: Floats, colours: NDArray[np.uint8]) -> None:
    """Corners [T, 3, 3] in metres and their RGB [T, 3, 3]; equal corners become one vertex."""
    corners = np.zeros(3 * len(triangles), dtype=_VERTEX)
    corners["position"] = triangles.reshape(-1, 3)
    corners["colour"] = colours.reshape(-1, 3)
    _, first, index = np.unique(corners.view(f"V{_VERTEX.itemsize}"), return_index=True, return_inverse=True)
    vertices = corners[first]
    faces = np.zeros(len(triangles), dtype=_FACE)
    faces["count"], faces["vertices"] = 3, index.reshape(-1, 3)
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    path.write_bytes(header.encode() + vertices.tobytes() + faces.tobytes())
