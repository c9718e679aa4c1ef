"""The mesh of a signed distance volume: naive surface nets (Gibson 1998), one vertex in each cell the surface crosses.

Chosen over marching cubes because the vertices are evenly spread, which the mesh change counts on, and because it is
an order of magnitude faster. Cells touching a voxel that was never seen stay empty, so surfaces end where the
observation ends.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ground_station.reconstruction.fusion import Volume
from ground_station.reconstruction.reconstructor import Mesh

FRONT: Final = 1
BACK: Final = 2
UNSEEN: Final = 4
NO_VERTEX: Final = -1


def extract_mesh(volume: Volume, weight_min: float) -> Mesh:
    """Faces wind counter-clockwise seen from the front. Voxels with less than ``weight_min`` count as unseen."""
    shape = volume.distance.shape
    sides = np.empty(shape, np.uint8)
    crossings = np.zeros(shape, np.uint8)
    _classify(volume.distance.ravel(), volume.weight.ravel(), np.float32(weight_min), sides.ravel())
    _find_crossed_cells(sides, crossings)
    vertex_count, face_bound = _count(crossings)
    vertices = np.empty((vertex_count, 3), np.float32)
    colors = np.empty((vertex_count, 3), np.uint8)
    faces = np.empty((face_bound, 3), np.int32)
    numbers = np.full((2, *shape[1:]), NO_VERTEX, np.int32)
    face_count = _build(volume.distance, volume.color, sides, crossings, numbers, vertices, colors, faces)
    vertices *= np.float32(volume.voxel)
    vertices += volume.origin.astype(np.float32)
    return Mesh(vertices, faces[:face_count], colors)


@njit(cache=True, nogil=True, error_model="numpy")
def _classify(
    distance: NDArray[np.float32], weight: NDArray[np.float32], weight_min: np.float32, sides: NDArray[np.uint8]
) -> None:
    for place in range(distance.size):
        side = np.uint8(FRONT) if distance[place] >= np.float32(0) else np.uint8(BACK)
        sides[place] = side if weight[place] >= weight_min else np.uint8(UNSEEN)


@njit(cache=True, nogil=True, error_model="numpy")
def _merge(first: NDArray[np.uint8], second: NDArray[np.uint8], merged: NDArray[np.uint8]) -> None:
    for k in range(merged.size):
        merged[k] = first[k] | second[k] | first[k + 1] | second[k + 1]


@njit(cache=True, nogil=True, error_model="numpy")
def _find_crossed_cells(sides: NDArray[np.uint8], crossings: NDArray[np.uint8]) -> None:
    """``crossings`` of a cell: its eight corners' sides united; it is crossed where they are front and back."""
    size_i, size_j, size_k = sides.shape
    near, far = np.empty(size_k - 1, np.uint8), np.empty(size_k - 1, np.uint8)
    for i in range(size_i - 1):
        for j in range(size_j - 1):
            _merge(sides[i, j], sides[i, j + 1], near)
            _merge(sides[i + 1, j], sides[i + 1, j + 1], far)
            row = crossings[i, j]
            for k in range(size_k - 1):
                row[k] = near[k] | far[k]


@njit(cache=True, nogil=True, error_model="numpy")
def _count(crossings: NDArray[np.uint8]) -> tuple[int, int]:
    """Number of vertices, and an upper bound of the number of triangles."""
    vertices = 0
    for i in range(crossings.shape[0]):
        for j in range(crossings.shape[1]):
            row = crossings[i, j]
            here = 0
            for k in range(row.size):
                here += 1 if row[k] == np.uint8(FRONT | BACK) else 0
            vertices += here
    return vertices, 6 * vertices


@njit(cache=True, nogil=True, error_model="numpy")
def _add_quad(
    faces: NDArray[np.int32], face: int, others: tuple[np.int32, np.int32, np.int32], last: int, flip: bool
) -> int:
    """Two triangles around a grid edge: the cells below and left of it, below, and left (``others``), and ``last``."""
    corner, second, fourth = others
    if corner == NO_VERTEX or second == NO_VERTEX or fourth == NO_VERTEX:
        return face
    if flip:
        second, fourth = fourth, second
    faces[face, 0], faces[face, 1], faces[face, 2] = corner, second, last
    faces[face + 1, 0], faces[face + 1, 1], faces[face + 1, 2] = corner, last, fourth
    return face + 2


@njit(cache=True, nogil=True, error_model="numpy")
def _place_vertex(
    distance: NDArray[np.float32],
    color: NDArray[np.uint8],
    i: int,
    j: int,
    k: int,
    vertex: NDArray[np.float32],
    vertex_color: NDArray[np.uint8],
) -> None:
    """Mean of the points where the cell's twelve edges cross the surface, in voxels; mean color of its corners."""
    x, y, z = np.float32(0), np.float32(0), np.float32(0)
    count = 0
    for a in range(2):
        for b in range(2):
            low, high = distance[i + a, j + b, k], distance[i + a, j + b, k + 1]
            if (low >= 0) != (high >= 0):
                x, y, z = x + np.float32(a), y + np.float32(b), z + low / (low - high)
                count += 1
            low, high = distance[i + a, j, k + b], distance[i + a, j + 1, k + b]
            if (low >= 0) != (high >= 0):
                x, y, z = x + np.float32(a), y + low / (low - high), z + np.float32(b)
                count += 1
            low, high = distance[i, j + a, k + b], distance[i + 1, j + a, k + b]
            if (low >= 0) != (high >= 0):
                x, y, z = x + low / (low - high), y + np.float32(a), z + np.float32(b)
                count += 1
    share = np.float32(1) / np.float32(count)
    vertex[0], vertex[1], vertex[2] = np.float32(i) + x * share, np.float32(j) + y * share, np.float32(k) + z * share
    red, green, blue, painted = 0, 0, 0, 0
    for a in range(2):
        for b in range(2):
            for c in range(2):
                r, g, u = color[i + a, j + b, k + c, 0], color[i + a, j + b, k + c, 1], color[i + a, j + b, k + c, 2]
                red, green, blue = red + r, green + g, blue + u
                painted += 1 if r or g or u else 0
    painted = max(painted, 1)
    vertex_color[0], vertex_color[1], vertex_color[2] = red // painted, green // painted, blue // painted


@njit(cache=True, nogil=True, error_model="numpy")
def _build(
    distance: NDArray[np.float32],
    color: NDArray[np.uint8],
    sides: NDArray[np.uint8],
    crossings: NDArray[np.uint8],
    numbers: NDArray[np.int32],
    vertices: NDArray[np.float32],
    colors: NDArray[np.uint8],
    faces: NDArray[np.int32],
) -> int:
    """Slab by slab; ``numbers`` holds the vertex numbers of this slab and the one before. Returns the face count."""
    size_i, size_j, size_k = sides.shape
    crossed = np.uint8(FRONT | BACK)
    vertex, face = 0, 0
    for i in range(size_i - 1):
        this, before = numbers[i % 2], numbers[1 - i % 2]
        this[:] = NO_VERTEX
        for j in range(size_j - 1):
            for k in range(size_k - 1):
                if crossings[i, j, k] != crossed:
                    continue
                this[j, k] = vertex
                _place_vertex(distance, color, i, j, k, vertices[vertex], colors[vertex])
                vertex += 1
                # The three grid edges at this cell's corner (i, j, k) are each shared with three cells numbered before.
                side = sides[i, j, k]
                flip = side == np.uint8(FRONT)
                if i > 0 and j > 0 and side != sides[i, j, k + 1]:
                    face = _add_quad(faces, face, (before[j - 1, k], this[j - 1, k], before[j, k]), vertex - 1, flip)
                if i > 0 and k > 0 and side != sides[i, j + 1, k]:
                    face = _add_quad(faces, face, (before[j, k - 1], before[j, k], this[j, k - 1]), vertex - 1, flip)
                if j > 0 and k > 0 and side != sides[i + 1, j, k]:
                    face = _add_quad(
                        faces, face, (this[j - 1, k - 1], this[j, k - 1], this[j - 1, k]), vertex - 1, flip
                    )
    return face
