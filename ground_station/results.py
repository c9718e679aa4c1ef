"""What a run leaves behind: one folder from which its report, its figures and its map can be made again.

* ``mission.json``: the effective mission, every default filled in.
* ``metrics.csv``: one row a second, readable while the run goes on and after it was killed.
* ``trajectories.npz``: ``drones`` ids (D,), ``tick`` and ``time_s`` (T,), ``poses`` (T, D, 5), NaN where a drone was
  not heard; of the controllers, (T, D), ``solve_time_s``, ``slack`` and ``fallback``: why the drone braked, or "".
* ``mesh.ply``, ``mesh.glb``: the map with vertex colours; PLY in the world frame, GLB with y up as glTF demands.
* ``summary.json``: the figures by which runs are compared, and hashes that show whether two runs were the same.
"""

from __future__ import annotations

import csv
import hashlib
import importlib.metadata
import io
import json
import math
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ground_station.evaluation import Scores
from ground_station.separation import nearest_distances
from protocol.errors import MissionError
from protocol.mission import Mission

MISSION_FILE = "mission.json"
METRICS_FILE = "metrics.csv"
TRAJECTORIES_FILE = "trajectories.npz"
MESH_PLY_FILE = "mesh.ply"
MESH_GLB_FILE = "mesh.glb"
SUMMARY_FILE = "summary.json"

COORDINATES = 5
"""x, y, z in metres, yaw and pitch in radians."""
DECIMALS = 6
"""Of the figures in metrics.csv and summary.json: micrometres and microseconds."""
GLB_MATERIAL = {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}, "doubleSided": True}
"""Without it viewers show glTF's default, a dark metal."""
PACKAGES = (
    "coverage-recon", "eclipse-zenoh", "mavsdk", "msgpack", "numba", "numpy", "open3d", "open3d-cpu", "osqp",
    "pydantic", "scipy", "torch", "trimesh",
)  # fmt: skip
"""Those whose version may change a result."""

Vertices: TypeAlias = NDArray[np.float32]
Faces: TypeAlias = NDArray[np.int32]
Colours: TypeAlias = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Metrics:
    """State of the run at one moment; counts are since its start."""

    time_s: float
    """Mission time."""
    tick: int
    importance: float
    """J of eq. (3)."""
    scores: Scores | None
    """None without a truth to compare with."""
    jumps: int
    keyframes: int


@dataclass(frozen=True, slots=True)
class Summary:
    """The outcome of a run."""

    mission: str
    seed: int
    drones: int
    exit_reason: str
    final: Metrics
    floor_baseline: Scores | None
    """What a bare floor scores in this scene; a map must beat it."""
    min_separation_m: float | None
    """Smallest distance between any two drones at any tick; None for a single drone."""
    fallbacks: Mapping[int, int]
    """Ticks in which each drone braked instead of following its controller."""
    wall_time_s: float
    phi_sha256: str
    """Of the final importance as little-endian float32."""
    mesh_sha256: str | None
    """Of the final mesh; None if there is none."""
    versions: Mapping[str, str]

    def as_json(self) -> dict[str, Any]:
        """The content of summary.json: flat where runs are compared, ``null`` for what the run did not have."""
        return {
            "mission": self.mission,
            "seed": self.seed,
            "drones": self.drones,
            "exit_reason": self.exit_reason,
            "J": _rounded(self.final.importance),
            **_flat(self.final.scores),
            "floor_baseline": _flat(self.floor_baseline),
            "min_separation_m": _rounded(self.min_separation_m),
            "jumps": self.final.jumps,
            "keyframes": self.final.keyframes,
            "fallbacks": {str(drone): count for drone, count in self.fallbacks.items()},
            "ticks": self.final.tick,
            "sim_time_s": _rounded(self.final.time_s),
            "wall_time_s": _rounded(self.wall_time_s),
            "phi_sha256": self.phi_sha256,
            "mesh_sha256": self.mesh_sha256,
            "versions": dict(self.versions),
        }


class RunFolder:
    """Writer of a run's folder; one process has it open.

    Raises MissionError if the folder holds another mission, or a flight: nothing that was recorded is written over.
    """

    def __init__(self, path: Path, mission: Mission) -> None:
        self.path = path
        self._mission = mission
        self._drones = sorted(drone.id for drone in mission.drones)
        self._column = {drone: index for index, drone in enumerate(self._drones)}
        self._ticks: list[int] = []
        self._times: list[float] = []
        self._poses: list[NDArray[np.float64]] = []
        self._solve_times: list[list[float]] = []
        self._slacks: list[list[float]] = []
        self._fallbacks: list[list[str]] = []
        self._separations = dict.fromkeys(self._drones, math.inf)
        self._min_separation = math.inf
        self._mesh_sha256: str | None = None

        path.mkdir(parents=True, exist_ok=True)
        self._keep_mission()
        file = path / METRICS_FILE
        if file.exists():
            raise MissionError([f"{file}: this folder holds a flight already; take a new one"])
        # Line buffered: each row reaches the operating system in one write, whatever then happens to this process.
        self._rows = file.open("x", buffering=1, encoding="utf-8", newline="")
        self._writer = csv.writer(self._rows, lineterminator="\n")
        self._writer.writerow(_columns(self._drones))

    def close(self) -> None:
        """Release the folder; may be repeated. What was recorded since the last checkpoint stays out of the npz."""
        self._rows.close()

    def record_tick(
        self,
        tick: int,
        time_s: float,
        poses: Mapping[int, Sequence[float]],
        solve_times_s: Mapping[int, float],
        slacks: Mapping[int, float],
        fallbacks: Mapping[int, str],
    ) -> None:
        """Keep one tick; every mapping goes by drone id and may lack drones that were not heard.

        ``poses`` are x, y, z in metres, yaw, pitch in radians; ``fallbacks`` say why a drone braked, "" if it did
        not. Costs some ten microseconds: it is called 200 times a second.
        """
        row = np.full((len(self._drones), COORDINATES), np.nan)
        for drone, pose in poses.items():
            row[self._column[drone]] = pose
        self._ticks.append(tick)
        self._times.append(time_s)
        self._poses.append(row)
        self._solve_times.append([solve_times_s.get(drone, math.nan) for drone in self._drones])
        self._slacks.append([slacks.get(drone, math.nan) for drone in self._drones])
        self._fallbacks.append([fallbacks.get(drone, "") for drone in self._drones])
        for drone, distance in nearest_distances(poses).items():
            self._separations[drone] = min(self._separations[drone], distance)
            self._min_separation = min(self._min_separation, distance)

    def record_metrics(self, metrics: Metrics) -> None:
        """Append a row. Separations are the smallest since the previous row, so no tick is hidden between rows."""
        separations = [self._separations[drone] for drone in self._drones]
        scores = metrics.scores
        row = [
            metrics.time_s,
            metrics.tick,
            metrics.importance,
            *((scores.visible.f, scores.exposed.f, scores.objects.f) if scores else (None,) * 3),
            *((scores.visible.precision, scores.visible.recall) if scores else (None,) * 2),
            metrics.jumps,
            metrics.keyframes,
            min(separations),
            *separations,
        ]
        self._writer.writerow([_rounded(value) for value in row])
        self._separations = dict.fromkeys(self._drones, math.inf)

    def write_mesh(self, vertices: Vertices, faces: Faces, colours: Colours) -> None:
        """Write the map: (V, 3) metres in the world frame, (F, 3) vertex indices, (V, 3) sRGB. No files if empty."""
        if not len(faces):
            return
        self._mesh_sha256 = mesh_sha256(vertices, faces)
        _write_atomically(self.path / MESH_PLY_FILE, _mesh_file(vertices, faces, colours, "ply"))
        _write_atomically(self.path / MESH_GLB_FILE, _glb(vertices, faces, colours))

    def checkpoint(self) -> None:
        """Write trajectories and solver outcomes recorded so far: what is left of them if the process is killed."""
        shape = (len(self._ticks), len(self._drones))
        content = io.BytesIO()
        np.savez_compressed(
            content,
            drones=np.array(self._drones),
            tick=np.array(self._ticks, dtype=np.int64),
            time_s=np.array(self._times, dtype=np.float64),
            poses=np.array(self._poses, dtype=np.float64).reshape(*shape, COORDINATES),
            solve_time_s=np.array(self._solve_times, dtype=np.float64).reshape(shape),
            slack=np.array(self._slacks, dtype=np.float64).reshape(shape),
            fallback=np.array(self._fallbacks, dtype=np.str_).reshape(shape),
        )
        _write_atomically(self.path / TRAJECTORIES_FILE, content.getvalue())

    def finish(
        self, final: Metrics, *, floor_baseline: Scores | None, phi_sha256: str, wall_time_s: float, exit_reason: str
    ) -> Summary:
        """Write the last checkpoint and the summary; the mesh must have been written before."""
        self.checkpoint()
        summary = Summary(
            mission=self._mission.name,
            seed=self._mission.seed,
            drones=len(self._drones),
            exit_reason=exit_reason,
            final=final,
            floor_baseline=floor_baseline,
            min_separation_m=self._min_separation if math.isfinite(self._min_separation) else None,
            fallbacks={
                drone: sum(bool(reasons[index]) for reasons in self._fallbacks) for drone, index in self._column.items()
            },
            wall_time_s=wall_time_s,
            phi_sha256=phi_sha256,
            mesh_sha256=self._mesh_sha256,
            versions=versions(),
        )
        text = json.dumps(summary.as_json(), indent=2, allow_nan=False) + "\n"
        _write_atomically(self.path / SUMMARY_FILE, text.encode())
        return summary

    def _keep_mission(self) -> None:
        path = self.path / MISSION_FILE
        content = (self._mission.model_dump_json(indent=2) + "\n").encode()
        if path.exists() and path.read_bytes() != content:
            raise MissionError([f"{path}: this run folder belongs to another mission"])
        _write_atomically(path, content)


def versions() -> dict[str, str]:
    """Versions of Python and of the installed packages that may change a result."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue  # an optional part that is not installed cannot have changed anything
    return found


def mesh_sha256(vertices: Vertices, faces: Faces) -> str:
    """Hash over the vertices as little-endian float32, then the faces as little-endian int32."""
    digest = hashlib.sha256(np.ascontiguousarray(vertices, dtype="<f4").tobytes())
    digest.update(np.ascontiguousarray(faces, dtype="<i4").tobytes())
    return digest.hexdigest()


def _columns(drones: Sequence[int]) -> list[str]:
    return [
        "time_s", "tick", "importance", "f_score_visible", "f_score_exposed", "f_score_objects", "precision", "recall",
        "jumps", "keyframes", "min_separation_m", *(f"separation_{drone}_m" for drone in drones),
    ]  # fmt: skip


def _flat(scores: Scores | None) -> dict[str, float | None]:
    """Keys as in metrics.csv; precision and recall are those of the visible surface unless named otherwise."""
    names = ("visible", "exposed", "objects")
    parts = {name: getattr(scores, name) if scores else None for name in names}
    return {
        **{f"f_score_{name}": _rounded(part.f) if part else None for name, part in parts.items()},
        **{f"precision_{name}": _rounded(part.precision) if part else None for name, part in parts.items()},
        **{f"recall_{name}": _rounded(part.recall) if part else None for name, part in parts.items()},
    }


def _rounded(value: float | None) -> float | None:
    """None for what there is not, NaN and infinity included: neither JSON nor every CSV reader knows them."""
    if value is None or not math.isfinite(value):
        return None
    return round(value, DECIMALS)


def _write_atomically(path: Path, content: bytes) -> None:
    """A reader sees the old file or the new one, and so does whoever looks after a power cut."""
    draft = path.with_name(f".{path.name}.draft")
    with draft.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    draft.replace(path)


def _mesh_file(vertices: Vertices, faces: Faces, colours: Colours, file_type: str, **options: Any) -> bytes:
    import trimesh

    content = io.BytesIO()
    mesh = trimesh.Trimesh(vertices, faces, vertex_colors=colours, process=False)
    mesh.export(content, file_type=file_type, **options)
    return content.getvalue()


def _glb(vertices: Vertices, faces: Faces, colours: Colours) -> bytes:
    """glTF 2.0: y up, right-handed, and vertex colours linear in light rather than sRGB (sections 3.4, 3.7.2.1)."""

    def add_material(tree: dict[str, Any]) -> None:
        tree["materials"] = [GLB_MATERIAL]
        tree["meshes"][0]["primitives"][0]["material"] = 0

    upright = np.column_stack([vertices[:, 0], vertices[:, 2], -vertices[:, 1]])
    level = np.arange(256) / 255
    linear = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
    shown = np.round(255 * linear).astype(np.uint8)[colours]
    return _mesh_file(upright, faces, shown, "glb", tree_postprocessor=add_material)
