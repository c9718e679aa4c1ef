"""How good the map is: precision, recall and F-score against the surface the simulator really had.

A bare floor already scores well on any F that includes the floor, so three figures are always given together,
beside those of a floor alone: visible surface, exposed surface, and objects without the floor.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Self, TypeAlias

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from protocol.errors import SceneError
from protocol.geometry import Floats
from protocol.mission import Box
from protocol.triangles import squared_distance

TRUTH_FILE = "truth_samples.npz"

THRESHOLD_M = 0.05
"""eta, the distance within which a point counts as reconstructed (paper)."""

FULL_SAMPLES = 200_000
"""Points drawn on the mesh, and kept of the truth, for the figures of a finished run: repeatable within 0.001."""
LIVE_SAMPLES = 16_000
"""The same for the curve shown in flight: within 0.005 of the full figure for a seventh of the time."""

OBJECT_MESH_M = 0.06
"""Mesh above this height over the target's lower face is no floor: threshold plus 1 cm of noise."""
OBJECT_TRUTH_M = 0.02
"""Truth above this height is an object's; rugs are thinner."""

CELL_THRESHOLDS = 2.0
"""Edge of the search cells in thresholds; the result does not depend on it, 1.5 to 2 were fastest of 1 to 3."""
CELLS_PER_AXIS = 128
"""Bounds the memory of the search cells in a large box."""

NO_THING = -1
"""Number of what is part of no furniture: floor, walls, and all of a scene whose parts are not known."""

Vertices: TypeAlias = NDArray[np.float32]
Faces: TypeAlias = NDArray[np.int32]
Mask: TypeAlias = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Score:
    """Shares in [0, 1] of points within the threshold: of the mesh, of the truth, and their harmonic mean."""

    precision: float
    recall: float
    f: float

    @classmethod
    def of(cls, precision: float, recall: float) -> Self:
        total = precision + recall
        return cls(precision, recall, 2 * precision * recall / total if total else 0.0)


@dataclass(frozen=True, slots=True)
class Scores:
    """Precision is against all exposed surface in each; recall differs."""

    visible: Score
    """Recall on what the drones' cameras could have seen from where they may fly."""
    exposed: Score
    """Recall on all that is visible from some free point."""
    objects: Score
    """Visible surface with the floor removed from mesh and truth."""


@dataclass(frozen=True, slots=True)
class Truth:
    """Points spread evenly by area over the scene's surface inside B, and which of them can be seen."""

    points: Vertices
    """(N, 3) metres, world frame; exposed points only."""
    visible: Mask
    """(N,)"""
    tree: cKDTree
    """Of ``points``."""
    thing: NDArray[np.int32]
    """(N,) which of ``names`` it is part of, or `NO_THING`."""
    names: tuple[str, ...]
    """Of the scene's furniture."""
    box: Box | None
    """In which the scene's surface was sampled, if the file says it."""

    @classmethod
    def of(
        cls,
        points: Vertices,
        exposed: Mask,
        visible: Mask,
        *,
        thing: NDArray[np.int32] | None = None,
        names: tuple[str, ...] = (),
        box: Box | None = None,
    ) -> Self:
        """From all samples, hidden ones too; points that are not exposed can be on no map and are left out."""
        if thing is None:
            thing = np.full(len(points), NO_THING, np.int32)
        kept = np.ascontiguousarray(points[exposed], dtype=np.float32)
        # An unbalanced tree is built in half the time and answers as fast on evenly spread points.
        tree = cKDTree(kept, balanced_tree=False, compact_nodes=False)
        return cls(kept, visible[exposed], tree, thing[exposed], names, box)


def load_truth(run: Path) -> Truth | None:
    """The truth that the simulator wrote into the run's folder; None if it wrote none, as in a real flight.

    Raises SceneError as `read_truth` does.
    """
    path = run / TRUTH_FILE
    return read_truth(path) if path.exists() else None


def read_truth(path: Path) -> Truth:
    """The file holds ``points`` float32 (N, 3), ``exposed`` and ``visible`` bool (N,); since 0.2 also ``thing`` int32
    (N,), ``names`` and ``box`` (2, 3).

    Raises SceneError, with the file's path, if it cannot be read or its arrays do not fit together.
    """
    try:
        with path.open("rb") as stream, np.load(stream) as file:
            points, exposed, visible = file["points"], file["exposed"], file["visible"]
            thing = file["thing"] if "thing" in file else np.full(len(points), NO_THING, np.int32)
            names = tuple(map(str, file["names"])) if "names" in file else ()
            ends = file.get("box")
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise SceneError(f"{path}: {error}") from error
    count = len(points)
    if points.shape != (count, 3) or any(array.shape != (count,) for array in (exposed, visible, thing)):
        raise SceneError(f"{path}: shapes do not fit: {points.shape}, {exposed.shape}, {visible.shape}, {thing.shape}")
    if exposed.dtype != np.bool_ or visible.dtype != np.bool_ or not np.isfinite(points).all():
        raise SceneError(f"{path}: points must be finite, exposed and visible bool")
    if thing.dtype != np.int32 or not np.isin(thing, np.arange(NO_THING, len(names))).all():
        raise SceneError(f"{path}: thing must be int32, each the number of one of {len(names)} names or {NO_THING}")
    try:
        box = None if ends is None else Box(lower_m=tuple(ends[0].tolist()), upper_m=tuple(ends[1].tolist()))
    except (ValueError, IndexError, AttributeError) as error:
        raise SceneError(f"{path}: box: {error}") from error
    return Truth.of(points, exposed, visible, thing=thing, names=names, box=box)


def score(
    vertices: Vertices,
    faces: Faces,
    truth: Truth,
    box: Box,
    threshold_m: float = THRESHOLD_M,
    seed: int = 0,
    samples: int = FULL_SAMPLES,
) -> Scores:
    """Scores of a mesh, (V, 3) metres in the world frame and (F, 3) vertex indices, against the truth inside ``box``.

    Precision: ``samples`` points drawn evenly by area on the mesh, kept if within the threshold of the box, against
    the exposed points. Recall: exact distance from about ``samples`` truth points to the mesh's triangles. Same
    arguments, same result; a mesh without area scores zero.
    """
    vertices = np.ascontiguousarray(vertices, dtype=np.float32)
    faces = np.ascontiguousarray(faces, dtype=np.int32)
    rng = np.random.default_rng(seed)
    lower, upper = np.array(box.lower_m), np.array(box.upper_m)
    object_mesh_z, object_truth_z = lower[2] + OBJECT_MESH_M, lower[2] + OBJECT_TRUTH_M

    drawn = sample_surface(vertices, faces, samples, rng)
    drawn = drawn[np.all((drawn >= lower - threshold_m) & (drawn <= upper + threshold_m), axis=1)]
    distances, _ = truth.tree.query(drawn, distance_upper_bound=threshold_m)
    right = np.isfinite(distances)

    step = max(1, len(truth.points) // samples)
    kept = slice(int(rng.integers(step)), None, step)
    points, visible = truth.points[kept], truth.visible[kept]
    inside = np.all((points >= lower) & (points <= upper), axis=1)
    points, visible = points[inside], visible[inside]
    near_any = near_surface(points, vertices, faces, threshold_m)
    objects = points[visible & (points[:, 2] > object_truth_z)]
    object_faces = faces[(vertices[:, 2] > object_mesh_z)[faces].any(axis=1)]

    precision = _share(right)
    return Scores(
        visible=Score.of(precision, _share(near_any[visible])),
        exposed=Score.of(precision, _share(near_any)),
        objects=Score.of(
            _share(right[drawn[:, 2] > object_mesh_z]),
            _share(near_surface(objects, vertices, object_faces, threshold_m)),
        ),
    )


def floor_baseline(truth: Truth, box: Box, threshold_m: float = THRESHOLD_M, seed: int = 0) -> Scores:
    """What a bare plane on the box's lower face scores: the figure that a map must be compared with."""
    (x0, y0, z), (x1, y1, _) = box.lower_m, box.upper_m
    corners = np.array([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]], np.float32)
    return score(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32), truth, box, threshold_m, seed)


def _share(mask: Mask) -> float:
    return float(np.count_nonzero(mask)) / mask.size if mask.size else 0.0


def sample_surface(vertices: Vertices, faces: Faces, count: int, rng: np.random.Generator) -> Floats:
    """(count, 3) points spread by area, or (0, 3) if there is none.

    Systematic: equal steps along the cumulated area. Neighbouring triangles follow each other in a mesh, so the
    result varies far less than with independent draws.
    """
    cumulated = _cumulated_area(vertices, faces)
    if not len(cumulated) or cumulated[-1] <= 0:
        return np.empty((0, 3))
    steps = (np.arange(count) + rng.random()) * (cumulated[-1] / count)
    chosen = faces[np.minimum(np.searchsorted(cumulated, steps, side="right"), len(faces) - 1)]
    # The square root makes the density even over the triangle (Osada et al. 2002, Shape Distributions).
    across, along = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    a, b, c = (vertices[chosen[:, corner]].astype(np.float64) for corner in range(3))
    drawn: Floats = (1 - across) * a + across * (1 - along) * b + across * along * c
    return drawn


@njit(cache=True, nogil=True)
def _cumulated_area(vertices: Vertices, faces: Faces) -> Floats:
    cumulated = np.empty(faces.shape[0])
    total = 0.0
    for face in range(faces.shape[0]):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        ux, uy, uz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
        vx, vy, vz = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        total += 0.5 * np.sqrt(nx * nx + ny * ny + nz * nz)
        cumulated[face] = total
    return cumulated


@njit(cache=True, nogil=True)
def near_surface(points: Vertices, vertices: Vertices, faces: Faces, threshold_m: float) -> Mask:
    """Which points (N, 3) lie within the threshold of any triangle; exact.

    Triangles visit the points in the cells around them, and a point that is settled leaves its cell. That needs no
    tree over the triangles, whose building would cost more than all queries of a live score.
    """
    near = np.zeros(points.shape[0], np.bool_)
    if not points.shape[0] or not faces.shape[0]:
        return near
    origin, edge, cells = np.empty(3), np.empty(3), np.empty(3, np.int64)
    for axis in range(3):
        origin[axis] = points[:, axis].min()
        extent = points[:, axis].max() - origin[axis]
        cells[axis] = min(max(1, int(extent / (CELL_THRESHOLDS * threshold_m))), CELLS_PER_AXIS)
        edge[axis] = max(extent, threshold_m) / cells[axis]

    cell_of = np.empty(points.shape[0], np.int64)
    active = np.zeros(cells[0] * cells[1] * cells[2], np.int64)
    for point in range(points.shape[0]):
        flat = 0
        for axis in range(3):
            index = int((points[point, axis] - origin[axis]) / edge[axis])
            flat = flat * cells[axis] + min(index, cells[axis] - 1)
        cell_of[point] = flat
        active[flat] += 1
    first = np.cumsum(active) - active
    members = np.empty(points.shape[0], np.int64)
    active[:] = 0
    for point in range(points.shape[0]):
        flat = cell_of[point]
        members[first[flat] + active[flat]] = point
        active[flat] += 1

    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    corner = np.empty((3, 3))
    for face in range(faces.shape[0]):
        reachable = True
        for axis in range(3):
            for vertex in range(3):
                corner[vertex, axis] = vertices[faces[face, vertex], axis]
            least = min(corner[0, axis], corner[1, axis], corner[2, axis]) - threshold_m - origin[axis]
            most = max(corner[0, axis], corner[1, axis], corner[2, axis]) + threshold_m - origin[axis]
            reachable = reachable and most >= 0 and least <= edge[axis] * cells[axis]
            low[axis] = max(0, int(least / edge[axis]))
            high[axis] = min(int(most / edge[axis]), cells[axis] - 1)
        if not reachable:
            continue
        for x in range(low[0], high[0] + 1):
            for y in range(low[1], high[1] + 1):
                for z in range(low[2], high[2] + 1):
                    flat = (x * cells[1] + y) * cells[2] + z
                    slot = first[flat]
                    while slot < first[flat] + active[flat]:
                        point = members[slot]
                        if squared_distance(points[point], corner) <= threshold_m * threshold_m:
                            near[point] = True
                            active[flat] -= 1
                            members[slot] = members[first[flat] + active[flat]]
                        else:
                            slot += 1
    return near
