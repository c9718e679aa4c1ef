"""The map as a mesh for other programs, and as a point cloud that is spread evenly over it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ground_station.mesh_files import glb, ply
from ground_station.reconstruction.reconstructor import Mesh
from protocol.errors import CovreconError

MeshFormat: TypeAlias = Literal["ply", "glb", "obj"]

SEED = 0
"""Of the points drawn on a mesh: the same mesh gives the same cloud."""
LINES_AT_ONCE = 65_536
CLOUD_POINT = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")] + [(name, "u1") for name in ("red", "green", "blue")]
)
"""Metres in the world frame, the unit normal of the front, sRGB; the names are those that readers of PLY look for."""


def mesh_file(mesh: Mesh, file_format: MeshFormat) -> bytes:
    """With vertex colours. PLY and OBJ in the world frame, z up; GLB with y up, as glTF demands."""
    if file_format == "obj":
        return b"".join(_obj(mesh))
    return {"ply": ply, "glb": glb}[file_format](mesh.vertices, mesh.faces, mesh.colors)


def _obj(mesh: Mesh) -> Iterator[bytes]:
    """Wavefront OBJ. Colours follow the coordinates, 0 to 1: no part of the format, but what its readers expect."""
    yield b"# metres, world frame, z up; x y z red green blue\n"
    rows = np.column_stack([mesh.vertices, mesh.colors / 255])
    for first in range(0, len(rows), LINES_AT_ONCE):
        part = rows[first : first + LINES_AT_ONCE]
        yield ("v %.6f %.6f %.6f %.4f %.4f %.4f\n" * len(part) % tuple(part.ravel())).encode()
    for first in range(0, len(mesh.faces), LINES_AT_ONCE):
        part = mesh.faces[first : first + LINES_AT_ONCE] + 1  # OBJ counts from 1
        yield ("f %d %d %d\n" * len(part) % tuple(part.ravel())).encode()


def sample(mesh: Mesh, count: int) -> NDArray[np.void]:
    """(count,) records of `CLOUD_POINT`, spread evenly over the mesh's area, colours in between those of the corners.

    Systematic: equal steps along the cumulated area, as neighbouring triangles follow each other in a mesh.

    Raises:
        CovreconError: the mesh has no area.
    """
    corners = mesh.vertices.astype(np.float64)[mesh.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled = np.linalg.norm(across, axis=1)
    cumulated = np.cumsum(doubled)
    if not len(cumulated) or not cumulated[-1] > 0:
        raise CovreconError("the map has no area")
    random = np.random.default_rng(SEED)
    steps = (np.arange(count) + random.random()) * (cumulated[-1] / count)
    # The last step may round up to the whole area; then it is of the last triangle that has any.
    chosen = np.minimum(np.searchsorted(cumulated, steps, side="right"), np.flatnonzero(doubled)[-1])
    # The square root makes the density even over the triangle (Osada et al. 2002, Shape Distributions).
    away, along = np.sqrt(random.random(count)), random.random(count)
    weights = np.column_stack([1 - away, away * (1 - along), away * along])[:, :, None]
    points = np.empty(count, CLOUD_POINT)
    columns = np.hstack(
        [
            (weights * corners[chosen]).sum(axis=1),
            across[chosen] / doubled[chosen, None],
            np.round((weights * mesh.colors[mesh.faces[chosen]]).sum(axis=1)),
        ]
    )
    for name, column in zip(CLOUD_POINT.fields or (), columns.T, strict=True):
        points[name] = column
    return points


def cloud_ply(points: NDArray[np.void]) -> bytes:
    """Binary PLY of records of `CLOUD_POINT`."""
    kinds = {"<f4": "float", "|u1": "uchar"}
    properties = [f"property {kinds[points.dtype[name].str]} {name}" for name in points.dtype.names or ()]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}", *properties, "end_header", ""]
    return "\n".join(lines).encode() + points.tobytes()
