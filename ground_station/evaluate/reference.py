"""What a map is measured against: the truth that a simulated run or scene wrote, or any mesh that is taken for true."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from ground_station.evaluation import TRUTH_FILE, Faces, Truth, Vertices, read_truth, sample_surface
from ground_station.flown_mission import read_mission
from ground_station.mesh_files import read_geometry
from ground_station.results import MESH_PLY_FILE, MISSION_FILE
from ground_station.study.plan_file import TRUTH_MESH_FILE
from protocol.errors import CovreconError
from protocol.mission import Box

SAMPLES_PER_M2: Final = 3500.0
"""On a mesh that is taken for true; as on scenes of the simulator."""
SAMPLES_MAX: Final = 5_000_000
"""However large that mesh is."""
MARGIN_M: Final = 0.05
"""Around a true mesh that no box is known for."""


@dataclass(frozen=True, slots=True)
class Reference:
    truth: Truth
    vertices: Vertices
    """(V, 3) of the true surface as triangles, to which distances are measured ..."""
    faces: Faces
    """... (F, 3); hidden surface too."""
    box: Box
    """Only what lies in it counts."""
    culled: bool
    """Whether hidden surface is known and left out."""


def map_of(path: Path) -> tuple[Vertices, Faces]:
    """The mesh at ``path``: a file, or that of a run's folder. Raises CovreconError."""
    file = path / MESH_PLY_FILE if path.is_dir() else path
    if path.is_dir() and not file.exists():
        raise CovreconError(f"{file}: no map: it is written when a flight has ended; covrecon reconstruct makes one")
    return read_geometry(file)


def box_of(path: Path) -> Box | None:
    """Which box the map at ``path`` is of: that of the mission in the same folder; None without one."""
    folder = path if path.is_dir() else path.parent
    return read_mission(folder).target if (folder / MISSION_FILE).exists() else None


def open_reference(path: Path, box: Box | None) -> Reference:
    """``path``: truth samples, a folder that holds some, or a mesh.

    ``box``: the map's, if it is known, where the truth does not know its own.

    Raises:
        SceneError: samples that cannot be read.
        CovreconError: another thing that cannot be, or is nothing to measure by.
    """
    samples = path / TRUTH_FILE if path.is_dir() else path
    if samples.suffix == ".npz":
        if not samples.exists():
            raise CovreconError(f"{samples}: no truth: only runs of simulated scenes have one")
        truth = read_truth(samples)
        vertices, faces = read_geometry(samples.with_name(TRUTH_MESH_FILE))
        if not len(truth.points):
            raise CovreconError(f"{samples}: nothing in it can be seen")
        return Reference(truth, vertices, faces, truth.box or box or _around(truth.points), culled=True)
    vertices, faces = read_geometry(path)
    box = box or box_of(path) or _around(vertices[faces.ravel()])
    truth = _truth_on(vertices, faces, path)
    return Reference(truth, vertices, faces, box, culled=False)


def _truth_on(vertices: Vertices, faces: Faces, path: Path) -> Truth:
    a, b, c = (vertices[faces[:, corner]].astype(np.float64) for corner in range(3))
    area = float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2
    count = min(SAMPLES_MAX, round(SAMPLES_PER_M2 * area))
    points = sample_surface(vertices, faces, count, np.random.default_rng(0)).astype(np.float32)
    if not len(points):
        raise CovreconError(f"{path}: its triangles have no area")
    everything = np.ones(len(points), np.bool_)
    return Truth.of(points, exposed=everything, visible=everything)


def _around(points: Vertices) -> Box:
    lower, upper = points.min(axis=0).astype(float), points.max(axis=0).astype(float) + MARGIN_M
    # The lower face stays where the surface ends: it is where a floor is looked for.
    lower[:2] -= MARGIN_M
    return Box(lower_m=tuple(lower.tolist()), upper_m=tuple(upper.tolist()))
