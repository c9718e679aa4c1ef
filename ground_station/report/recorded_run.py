"""A run as arrays, from its recording alone: a report can be made of any, also of one that was cut short."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ground_station.mesh_files import read_glb, read_ply
from ground_station.recording.entries import IntegratedTick
from ground_station.recording.reader import Recording
from ground_station.recording.states import NewestStates
from ground_station.report.history import read_history
from ground_station.report.run_data import Curves, Mesh, Run, flight_of
from ground_station.trajectories import Trajectories
from protocol.geometry import Floats

_SCORES = {
    "f_score_visible": ("visible", "f"),
    "f_score_exposed": ("exposed", "f"),
    "f_score_objects": ("objects", "f"),
    "precision": ("visible", "precision"),
    "recall": ("visible", "recall"),
}
"""Columns of metrics.csv, and where a recorded row has them."""


def load_recording(path: Path) -> Run:
    """The run that was recorded at ``path``, as far as it was and as it is whole.

    Raises:
        RecordingError: it is no recording, or holds none of this version's missions.
        CovreconError: its map is damaged.
    """
    recording = Recording.open(path, salvage=True)
    drones = [drone.id for drone in recording.mission.drones]
    trajectories = Trajectories(drones)
    states = NewestStates({drone: recording.states(drone) for drone in drones})
    for entry in recording.inputs():
        if isinstance(entry, IntegratedTick):
            poses = dict(zip(entry.ids, entry.poses.tolist(), strict=True))
            trajectories.add(entry.tick, entry.tick * recording.mission.tick_s, poses, states.at(entry.tick))
    flown = trajectories.arrays()
    return Run(
        mission=recording.mission,
        curves=_curves(recording.metrics(), drones, flown["tick"], _nearest(flown["poses"])),
        flight=flight_of(flown) if len(flown["tick"]) else None,
        mesh=_mesh(recording, path),
        summary=recording.summary(),
        history=read_history([recording]),
    )


def _curves(
    rows: Sequence[Mapping[str, Any]], drones: Sequence[int], ticks: NDArray[np.int64], nearest: Floats
) -> Curves:
    """As the columns of metrics.csv; ``nearest`` is (T, D), of ``ticks`` (T,)."""
    kept: list[Mapping[str, Any]] = []
    for row in rows:
        if not kept or row["tick"] > kept[-1]["tick"]:
            kept.append(row)
    if not kept:
        return {}
    ends = np.searchsorted(ticks, [row["tick"] for row in kept], side="right")
    between = [nearest[first:last] for first, last in itertools.pairwise([0, *ends])]
    separations = np.array([np.fmin.reduce(part, axis=0, initial=np.inf) for part in between])
    separations[np.isinf(separations)] = np.nan
    columns = {name: [row[name] for row in kept] for name in ("time_s", "tick", "importance")}
    for name, (surface, figure) in _SCORES.items():
        columns[name] = [row["scores"][surface][figure] if row["scores"] else np.nan for row in kept]
    columns |= {name: [row[name] for row in kept] for name in ("jumps", "keyframes")}
    return {
        **{name: np.array(column, np.float64) for name, column in columns.items()},
        "min_separation_m": np.fmin.reduce(separations, axis=1),
        **{f"separation_{drone}_m": separations[:, index] for index, drone in enumerate(drones)},
    }


def _nearest(poses: Floats) -> Floats:
    """Distance of each drone to its nearest neighbour at each tick, (T, D) m; infinite for a lone one. ``poses`` are
    (T, D, 5), NaN where a drone was not heard."""
    nearest = np.full(poses.shape[:2], np.inf)
    for one, other in itertools.combinations(range(poses.shape[1]), 2):
        distance = np.linalg.norm(poses[:, one, :3] - poses[:, other, :3], axis=1)
        for drone in (one, other):
            nearest[:, drone] = np.fmin(nearest[:, drone], distance)
    return nearest


def _mesh(recording: Recording, path: Path) -> Mesh | None:
    """The final map, or the newest of a flight that was cut short."""
    ply = recording.final_mesh_ply()
    if ply is not None:
        found = read_ply(ply, f"{path}: final map")
    else:
        tick, glb = -1, b""
        for tick, glb in recording.meshes():  # noqa: B007  # the last is wanted
            pass
        if not glb:
            return None
        found = read_glb(glb, f"{path}: map of tick {tick}")
    return Mesh(found.vertices, found.faces, found.colors)
