"""How far a surface has moved between two point clouds: M3C2 (Lague, Brodu and Leroux, 2013), on one thread.

Around a core point, a cylinder along the surface's normal is cut out of both clouds; the distance is that between the
mean positions along the normal. Clouds are sorted into the cells of a lattice, which serves for three things: to find
the points of a cylinder, to see where two clouds differ at all, and to take core points evenly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ground_station.reconstruction.reconstructor import Mesh
from protocol.field import cell_centres
from protocol.geometry import Floats
from protocol.mission import Box

NOWHERE: Final = -1


@dataclass(frozen=True, slots=True, eq=False)
class Lattice:
    """Cells over a box and one more on every side of it, since a surface in the box's face scatters to both sides."""

    lower: Floats
    """(3,) m, corner of the first cell."""
    edges: Floats
    """(3,) m, of a cell."""
    shape: tuple[int, int, int]

    @classmethod
    def over(cls, box: Box, wished_m: float) -> Self:
        lower, upper = np.array(box.lower_m), np.array(box.upper_m)
        counts = [len(cell_centres(low, high, wished_m)) for low, high in zip(lower, upper, strict=True)]
        edges = (upper - lower) / counts
        return cls(lower - edges, edges, (counts[0] + 2, counts[1] + 2, counts[2] + 2))

    @property
    def size(self) -> int:
        x, y, z = self.shape
        return x * y * z


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """The vertices of one mesh that lie in a lattice."""

    points: NDArray[np.float32]
    """(P, 3) m, cell by cell; within a cell in the mesh's order."""
    starts: NDArray[np.int32]
    """(cells + 1,) where each cell's points begin."""
    marks: NDArray[np.uint64]
    """(cells,) a number that cells with the same points share, in whatever order."""
    cores: Floats
    """(cells, 3) m: of each cell the vertex nearest to its centre, of those that have a normal; NaN where none has."""
    normals: Floats
    """(cells, 3) unit vectors, the mesh's at ``cores``."""

    @classmethod
    def of(cls, mesh: Mesh, lattice: Lattice) -> Self:
        vertices = np.ascontiguousarray(mesh.vertices, np.float32)
        faces = np.ascontiguousarray(mesh.faces, np.int32)
        order, starts, marks = _sort(vertices, vertices.view(np.uint32), lattice.lower, lattice.edges, lattice.shape)
        upright = _vertex_normals(vertices, faces)
        cores, normals = _choose_cores(vertices, upright, order, starts, lattice.lower, lattice.edges, lattice.shape)
        return cls(vertices[order], starts, marks, cores, normals)


def core_points(before: Cloud, after: Cloud) -> tuple[Floats, Floats]:
    """(K, 3) positions and normals: one in every cell that holds surface, of the newer mesh where that has any.

    With those of one mesh alone, nothing that appeared, or nothing that vanished, would be seen.
    """
    newer = np.isfinite(after.cores[:, 0])
    cores = np.where(newer[:, None], after.cores, before.cores)
    normals = np.where(newer[:, None], after.normals, before.normals)
    present = np.isfinite(cores[:, 0])
    return cores[present], normals[present]


def changed_cells(before: Cloud, after: Cloud) -> NDArray[np.bool_]:
    """(cells,) whether a cell's points differ."""
    return np.not_equal(before.marks, after.marks)


def displacements(
    cores: Floats,
    normals: Floats,
    clouds: tuple[Cloud, Cloud],
    lattice: Lattice,
    radius_m: float,
    half_length_m: float,
    cells: NDArray[np.bool_],
) -> tuple[Floats, NDArray[np.int32]]:
    """(K,) distance in metres from the first cloud to the second along the normal, and (K, 2) points of each in the
    cylinder.

    The distance is NaN where either cloud has no point in the cylinder. Core points whose cylinder meets none of
    ``cells`` (cells,) are left out: distance 0, no points. With the cells that changed, what is left out is 0 anyway.
    """
    first, second = clouds
    return _displacements(
        cores,
        normals,
        (first.points, second.points),
        (first.starts, second.starts),
        (lattice.lower, lattice.edges),
        lattice.shape,
        (radius_m, half_length_m),
        cells,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _mix(bits: np.uint64) -> np.uint64:
    """Scatters 64 bits (the finaliser of SplitMix64, Steele and others, 2014)."""
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return bits ^ (bits >> np.uint64(31))


@njit(cache=True, nogil=True, error_model="numpy")
def _sort(
    vertices: NDArray[np.float32],
    bits: NDArray[np.uint32],
    lower: Floats,
    edges: Floats,
    shape: tuple[int, int, int],
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.uint64]]:
    """Vertex numbers by cell, where each cell's begin, and each cell's mark; vertices off the lattice are left out.

    ``bits`` are those of ``vertices``. A mark is the sum of its points' scattered bits, which does not depend on order.
    """
    cells = shape[0] * shape[1] * shape[2]
    starts = np.zeros(cells + 1, np.int32)
    marks = np.zeros(cells, np.uint64)
    places = np.empty(vertices.shape[0], np.int32)
    for vertex in range(vertices.shape[0]):
        place = 0
        for axis in range(3):
            index = np.floor((np.float64(vertices[vertex, axis]) - lower[axis]) / edges[axis])
            if not (0.0 <= index < shape[axis]):
                place = NOWHERE
                break
            place = place * shape[axis] + int(index)
        places[vertex] = place
        if place == NOWHERE:
            continue
        starts[place + 1] += 1
        plane = np.uint64(bits[vertex, 0]) | (np.uint64(bits[vertex, 1]) << np.uint64(32))
        marks[place] += _mix(_mix(plane) ^ np.uint64(bits[vertex, 2]))
    for cell in range(cells):
        starts[cell + 1] += starts[cell]
    order = np.empty(starts[cells], np.int32)
    following = starts[:-1].copy()
    for vertex in range(places.size):
        place = places[vertex]
        if place != NOWHERE:
            order[following[place]] = vertex
            following[place] += 1
    return order, starts, marks


@njit(cache=True, nogil=True, error_model="numpy")
def _vertex_normals(vertices: NDArray[np.float32], faces: NDArray[np.int32]) -> NDArray[np.float32]:
    """(V, 3): the sum of the normals of a vertex's faces, each as long as twice its area; 0 without faces."""
    normals = np.zeros(vertices.shape, np.float32)
    for face in range(faces.shape[0]):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        ux, uy, uz = (
            vertices[b, 0] - vertices[a, 0],
            vertices[b, 1] - vertices[a, 1],
            vertices[b, 2] - vertices[a, 2],
        )
        vx, vy, vz = (
            vertices[c, 0] - vertices[a, 0],
            vertices[c, 1] - vertices[a, 1],
            vertices[c, 2] - vertices[a, 2],
        )
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        for corner in (a, b, c):
            normals[corner, 0] += x
            normals[corner, 1] += y
            normals[corner, 2] += z
    return normals


@njit(cache=True, nogil=True, error_model="numpy")
def _choose_cores(
    vertices: NDArray[np.float32],
    upright: NDArray[np.float32],
    order: NDArray[np.int32],
    starts: NDArray[np.int32],
    lower: Floats,
    edges: Floats,
    shape: tuple[int, int, int],
) -> tuple[Floats, Floats]:
    """`Cloud.cores` and `Cloud.normals`; of vertices as near the first in the mesh's order."""
    cells = starts.size - 1
    cores, normals = np.full((cells, 3), np.nan), np.full((cells, 3), np.nan)
    centre, normal = np.empty(3), np.empty(3)
    for cell in range(cells):
        if starts[cell] == starts[cell + 1]:
            continue
        centre[0] = lower[0] + (cell // (shape[1] * shape[2]) + 0.5) * edges[0]
        centre[1] = lower[1] + (cell // shape[2] % shape[1] + 0.5) * edges[1]
        centre[2] = lower[2] + (cell % shape[2] + 0.5) * edges[2]
        nearest = np.inf
        for place in range(starts[cell], starts[cell + 1]):
            vertex = order[place]
            gap, length = 0.0, 0.0
            for axis in range(3):
                gap += (vertices[vertex, axis] - centre[axis]) ** 2
                normal[axis] = upright[vertex, axis]
                length += normal[axis] ** 2
            if gap < nearest and length > 0.0:
                nearest, length = gap, np.sqrt(length)
                for axis in range(3):
                    cores[cell, axis] = vertices[vertex, axis]
                    normals[cell, axis] = normal[axis] / length
    return cores, normals


@njit(cache=True, nogil=True, error_model="numpy")
def _cells_of_cylinder(
    core: Floats,
    normal: Floats,
    frame: tuple[Floats, Floats],
    shape: tuple[int, int, int],
    cylinder: tuple[float, float],
    found: NDArray[np.int64],
) -> int:
    """Into ``found`` the cells that the cylinder may meet; how many. ``frame`` is the lattice's lower and edges."""
    lower, edges = frame
    radius, half_length = cylinder
    first, last = np.empty(3, np.int64), np.empty(3, np.int64)
    for axis in range(3):
        reach = half_length * abs(normal[axis]) + radius * np.sqrt(max(0.0, 1.0 - normal[axis] ** 2))
        first[axis] = max(0, int(np.floor((core[axis] - reach - lower[axis]) / edges[axis])))
        last[axis] = min(shape[axis] - 1, int(np.floor((core[axis] + reach - lower[axis]) / edges[axis])))
    # A cell whose centre is farther from the axis than this lies outside.
    farthest = (radius + 0.5 * np.sqrt(edges[0] ** 2 + edges[1] ** 2 + edges[2] ** 2)) ** 2
    count = 0
    for i in range(first[0], last[0] + 1):
        x = lower[0] + (i + 0.5) * edges[0] - core[0]
        for j in range(first[1], last[1] + 1):
            y = lower[1] + (j + 0.5) * edges[1] - core[1]
            for k in range(first[2], last[2] + 1):
                z = lower[2] + (k + 0.5) * edges[2] - core[2]
                along = x * normal[0] + y * normal[1] + z * normal[2]
                if x * x + y * y + z * z - along * along <= farthest:
                    found[count] = (i * shape[1] + j) * shape[2] + k
                    count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _mean_along(
    core: Floats,
    normal: Floats,
    points: NDArray[np.float32],
    starts: NDArray[np.int32],
    cylinder: tuple[float, float],
    cells: NDArray[np.int64],
) -> tuple[float, int]:
    """Mean position along the normal of the points in the cylinder, NaN without any, and their number."""
    radius, half_length = cylinder
    total, count = 0.0, 0
    for cell in cells:
        for point in range(starts[cell], starts[cell + 1]):
            x, y, z = points[point, 0] - core[0], points[point, 1] - core[1], points[point, 2] - core[2]
            along = x * normal[0] + y * normal[1] + z * normal[2]
            if abs(along) <= half_length and x * x + y * y + z * z - along * along <= radius * radius:
                total += along
                count += 1
    return (total / count if count else np.nan), count


@njit(cache=True, nogil=True, error_model="numpy")
def _displacements(
    cores: Floats,
    normals: Floats,
    points: tuple[NDArray[np.float32], NDArray[np.float32]],
    starts: tuple[NDArray[np.int32], NDArray[np.int32]],
    frame: tuple[Floats, Floats],
    shape: tuple[int, int, int],
    cylinder: tuple[float, float],
    cells: NDArray[np.bool_],
) -> tuple[Floats, NDArray[np.int32]]:
    distances, counts = np.zeros(cores.shape[0]), np.zeros((cores.shape[0], 2), np.int32)
    reach = cylinder[0] + cylinder[1]
    room = 1
    for axis in range(3):
        room *= min(shape[axis], int(2.0 * reach / frame[1][axis]) + 2)
    found = np.empty(room, np.int64)
    for k in range(cores.shape[0]):
        core, normal = cores[k], normals[k]
        count = _cells_of_cylinder(core, normal, frame, shape, cylinder, found)
        concerned = False
        for place in range(count):
            if cells[found[place]]:
                concerned = True
                break
        if concerned:
            before, counts[k, 0] = _mean_along(core, normal, points[0], starts[0], cylinder, found[:count])
            after, counts[k, 1] = _mean_along(core, normal, points[1], starts[1], cylinder, found[:count])
            distances[k] = after - before
    return distances, counts
