"""A run's folder as arrays, with every part but the mission optional: runs crash, and not all have a map or a truth."""

from __future__ import annotations

import csv
import json
import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from ground_station import results
from protocol.errors import CovreconError, MissionError
from protocol.geometry import Floats
from protocol.mission import Mission

Curves: TypeAlias = Mapping[str, Floats]
"""Columns of metrics.csv by name, each (rows,); NaN where a cell is empty. No rows if the file is missing."""


@dataclass(frozen=True, slots=True)
class Flight:
    """What trajectories.npz holds; shapes and units in `ground_station.results`."""

    drones: NDArray[np.int64]
    time_s: Floats
    poses: Floats
    solve_time_s: Floats
    slack: Floats
    fallback: NDArray[np.str_]


@dataclass(frozen=True, slots=True)
class Mesh:
    vertices: NDArray[np.float32]
    """(V, 3) metres, world frame."""
    faces: NDArray[np.int32]
    """(F, 3)"""
    colours: NDArray[np.uint8]
    """(V, 3) sRGB."""


@dataclass(frozen=True, slots=True)
class Run:
    mission: Mission
    curves: Curves
    flight: Flight | None
    mesh: Mesh | None
    summary: Mapping[str, Any] | None
    """summary.json; None if the run was cut short."""

    def last(self, column: str) -> float:
        """Newest value of a column of metrics.csv that is not empty, NaN if there is none."""
        known = self.curves.get(column, np.empty(0))
        known = known[np.isfinite(known)]
        return float(known[-1]) if len(known) else math.nan


def load_run(folder: Path) -> Run:
    """Raises MissionError without a readable mission, CovreconError naming any other file that cannot be read."""
    return Run(
        mission=_mission(folder / results.MISSION_FILE),
        curves=_curves(folder / results.METRICS_FILE),
        flight=_flight(folder / results.TRAJECTORIES_FILE),
        mesh=_mesh(folder / results.MESH_PLY_FILE),
        summary=_summary(folder / results.SUMMARY_FILE),
    )


def _mission(path: Path) -> Mission:
    try:
        return Mission.model_validate_json(path.read_bytes())
    except OSError as error:
        raise MissionError([f"{path}: {error.strerror}; is this the folder of a run?"]) from error
    except ValidationError as error:
        raise MissionError([f"{path}: {fault['loc']}: {fault['msg']}" for fault in error.errors()]) from error


def _curves(path: Path) -> Curves:
    if not path.exists():
        return {}
    try:
        with path.open(encoding="utf-8", newline="") as file:
            reader = csv.DictReader(file)
            # A row torn by a full disk or a power cut lacks its last cells.
            rows = [row for row in reader if None not in row.values()]
            names = reader.fieldnames or ()
        return {name: np.array([float(row[name] or "nan") for row in rows]) for name in names}
    except ValueError as error:
        raise CovreconError(f"{path}: {error}") from error


def _flight(path: Path) -> Flight | None:
    if not path.exists():
        return None
    try:
        with path.open("rb") as stream, np.load(stream) as file:
            return Flight(**{name: file[name] for name in Flight.__slots__})
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise CovreconError(f"{path}: {error}") from error


def _mesh(path: Path) -> Mesh | None:
    if not path.exists():
        return None
    import trimesh

    try:
        mesh = trimesh.load_mesh(path, process=False)
    except (OSError, ValueError, KeyError, IndexError) as error:
        raise CovreconError(f"{path}: {error}") from error
    if not isinstance(mesh.visual, trimesh.visual.ColorVisuals):
        raise CovreconError(f"{path}: has no vertex colours")
    colours = np.asarray(mesh.visual.vertex_colors, dtype=np.uint8)[:, :3]
    return Mesh(mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32), colours)


def _summary(path: Path) -> Mapping[str, Any] | None:
    if not path.exists():
        return None
    try:
        summary: Mapping[str, Any] = json.loads(path.read_bytes())
    except ValueError as error:
        raise CovreconError(f"{path}: {error}") from error
    return summary
