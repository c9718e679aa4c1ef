"""Reads a run's folder, whole or cut short."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ground_station import results
from ground_station.flown_mission import read_mission
from ground_station.mesh_files import read_ply
from ground_station.report.history import history_of
from ground_station.report.run_data import Curves, Flight, Mesh, Run, flight_of
from ground_station.trajectories import read_trajectories
from protocol.errors import CovreconError


def load_run(folder: Path) -> Run:
    """Raises MissionError without a readable mission, CovreconError naming any other file that cannot be read."""
    return Run(
        mission=read_mission(folder),
        curves=_curves(folder / results.METRICS_FILE),
        flight=_flight(folder / results.TRAJECTORIES_FILE),
        mesh=_mesh(folder / results.MESH_PLY_FILE),
        summary=_summary(folder / results.SUMMARY_FILE),
        history=history_of(folder),
    )


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
        return flight_of(read_trajectories(path))
    except (OSError, ValueError) as error:
        raise CovreconError(f"{path}: {error}") from error


def _mesh(path: Path) -> Mesh | None:
    if not path.exists():
        return None
    try:
        found = read_ply(path.read_bytes(), str(path))
    except OSError as error:
        raise CovreconError(f"{path}: {error.strerror}") from error
    return Mesh(found.vertices, found.faces, found.colors)


def _summary(path: Path) -> Mapping[str, Any] | None:
    if not path.exists():
        return None
    try:
        summary: Mapping[str, Any] = json.loads(path.read_bytes())
    except ValueError as error:
        raise CovreconError(f"{path}: {error}") from error
    return summary
