"""What a run leaves behind: one folder from which its report, its figures and its map can be made again.

* ``mission.json``: the effective mission, every default filled in.
* ``metrics.csv``: one row a second, readable while the run goes on and after it was killed.
* ``trajectories.npz``: ``drones`` ids (D,), ``tick`` and ``time_s`` (T,), ``poses`` (T, D, 5), NaN where a drone was
  not heard; of the controllers, (T, D), ``solve_time_s``, ``slack``, ``telemetry_age_s``, ``separation_margin_m2``,
  ``region_margin_m``, ``pitch_margin_rad2``, ``obstacle_margin_m`` and ``fallback``: why the drone braked, or ""; of
  the vehicles, (T, D), ``mode`` ("" where not heard), ``battery`` (0 to 1) and ``position_sd_m``. Ticks between the
  last checkpoint and a crash are missing.
* ``phi.npz``: the final importance ``phi`` float32 (positions, directions), and its lattice: ``xs``, ``ys``, ``zs`` in
  metres, position number = (ix * len(ys) + iy) * len(zs) + iz, and ``directions`` (directions, 3), unit vectors.
* ``mesh.ply``, ``mesh.glb``: the map with vertex colours; PLY in the world frame, GLB with y up as glTF demands.
* ``summary.json``: the figures by which runs are compared, and hashes that show whether two runs were the same.
"""

from __future__ import annotations

import importlib.metadata
import io
import json
import logging
import math
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ground_station.durable import DiskFaults, replace_file, set_aside
from ground_station.evaluation import Scores
from ground_station.journal import JOURNAL_FILE
from ground_station.mesh_files import Colours, Faces, Vertices, glb, mesh_sha256, ply
from ground_station.metrics_file import MetricsFile
from ground_station.pose_errors import PoseErrorFigures
from ground_station.separation import nearest_distances
from ground_station.trajectories import Trajectories
from protocol.errors import MissionError, StorageError
from protocol.field import VirtualField
from protocol.messages import DroneState
from protocol.mission import Mission

log = logging.getLogger(__name__)

MISSION_FILE = "mission.json"
METRICS_FILE = "metrics.csv"
TRAJECTORIES_FILE = "trajectories.npz"
PHI_FILE = "phi.npz"
MESH_PLY_FILE = "mesh.ply"
MESH_GLB_FILE = "mesh.glb"
SUMMARY_FILE = "summary.json"

METRICS_PERIOD_S = 1.0
"""Mission time between two rows of metrics.csv."""
DECIMALS = 6
"""Of the figures in metrics.csv and summary.json: micrometres and microseconds."""
PACKAGES = (
    "coverage-recon", "eclipse-zenoh", "kiss-icp", "mavsdk", "msgpack", "numba", "numpy", "open3d", "open3d-cpu",
    "osqp", "pydantic", "scipy", "torch", "trimesh",
)  # fmt: skip
"""Those whose version may change a result."""


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
    feedback_update_s: float | None = None
    """Mean wall time of one update of the feedback, two meshes to h2; None without feedback."""
    pose_errors: PoseErrorFigures | None = None
    """None where a simulator's drones know where they are, or nobody knows the truth."""
    unlocated: int = 0
    """Keyframes that were left out of the map because their poses were too bad."""
    contacts: Mapping[int, int] | None = None
    """How often each simulated vehicle began to touch the scene; None where no simulator tells."""
    min_obstacle_margin_m: float | None = None
    """Smallest barrier of what was not seen free, of any drone at any tick; None where there was no such row."""
    fallbacks_among_obstacles: Mapping[int, int] | None = None
    """Those ``fallbacks`` in which there was one; None in missions without obstacles."""

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
            "fallbacks": _by_drone(self.fallbacks),
            "ticks": self.final.tick,
            "sim_time_s": _rounded(self.final.time_s),
            "wall_time_s": _rounded(self.wall_time_s),
            "feedback_update_s": _rounded(self.feedback_update_s),
            **_pose_figures(self.pose_errors),
            "keyframes_unlocated": self.unlocated,
            "contacts": _by_drone(self.contacts),
            "min_obstacle_margin_m": _rounded(self.min_obstacle_margin_m),
            "fallbacks_among_obstacles": _by_drone(self.fallbacks_among_obstacles),
            "phi_sha256": self.phi_sha256,
            "mesh_sha256": self.mesh_sha256,
            "versions": dict(self.versions),
        }


class RunFolder:
    """Writer of a run's folder; one process has it open. During the flight a disk that refuses is said and counted.

    Opened again after a crash it goes on: rows are appended, and trajectories continue from the last checkpoint.
    """

    def __init__(self, path: Path, mission: Mission) -> None:
        """Open or create.

        Raises:
            MissionError: it holds another mission, or a flight that cannot be gone on with, being finished or without
                a journal: nothing that was recorded is written over.
            StorageError: the disk refuses it.
        """
        self.path = path
        self._mission = mission
        self._drones = sorted(drone.id for drone in mission.drones)
        self._separations = dict.fromkeys(self._drones, math.inf)
        self._min_separation = math.inf
        self._last_row = -1
        self._mesh_sha256: str | None = None
        self._trajectories = Trajectories(self._drones)
        self._faults = DiskFaults(f"{path}: record of the flight")
        try:
            path.mkdir(parents=True, exist_ok=True)
            self._keep_mission()
            self._metrics = self._open_metrics()
            self._resume()
        except OSError as error:
            raise _storage_error(path, error) from error

    def _open_metrics(self) -> MetricsFile:
        file = self.path / METRICS_FILE
        if (self.path / SUMMARY_FILE).exists():
            raise MissionError([f"{file}: this folder holds a flight already; take a new one"])
        try:
            metrics = MetricsFile(file, _columns(self._drones), self._faults)
        except ValueError as error:
            log.error("%s %s; it is now %s", file, error, set_aside(file).name)  # noqa: TRY400  # the file is wrong
            return self._open_metrics()
        crashed = any(self.path.glob(f"{JOURNAL_FILE}*"))  # also one that was set aside
        if metrics.rows() and not crashed:
            metrics.close()
            raise MissionError([f"{file}: this folder holds a flight already; take a new one"])
        return metrics

    def _resume(self) -> None:
        rows = self._metrics.rows()
        self._last_row = int(max((row.get("tick", -1) for row in rows), default=-1))
        self._min_separation = min((row.get("min_separation_m", math.inf) for row in rows), default=math.inf)
        file = self.path / TRAJECTORIES_FILE
        if not file.exists():
            return
        try:
            self._trajectories.read(file)
        except ValueError as error:
            log.error("%s: %s; it is now %s", file, error, set_aside(file).name)  # noqa: TRY400  # the file is wrong

    @property
    def refused_writes(self) -> int:
        """How often the disk refused a row or a checkpoint; they are kept in memory and tried again."""
        return self._faults.count

    @property
    def min_separation_m(self) -> float | None:
        """Smallest distance between any two drones so far, also before a crash; None for a single drone."""
        return self._min_separation if math.isfinite(self._min_separation) else None

    def close(self) -> None:
        """Release the folder; may be repeated. What was recorded since the last checkpoint stays out of the npz."""
        self._metrics.close()

    def record_tick(
        self,
        tick: int,
        time_s: float,
        poses: Mapping[int, Sequence[float]],
        states: Mapping[int, DroneState],
        truth: Mapping[int, Sequence[float]] | None = None,
    ) -> None:
        """Keep one tick; every mapping goes by drone id and may lack drones that were not heard.

        ``poses`` are x, y, z in metres, yaw, pitch in radians; ``states`` the newest heard; ``truth`` the true poses
        where they are known to be others, by which separation is judged. Costs some ten
        microseconds: it is called 200 times a second.
        """
        self._trajectories.add(tick, time_s, poses, states)
        for drone, distance in nearest_distances(truth or poses).items():
            self._separations[drone] = min(self._separations[drone], distance)
            self._min_separation = min(self._min_separation, distance)

    def record_metrics(self, metrics: Metrics) -> None:
        """Append a row. Separations are the smallest since the previous row, so no tick is hidden between rows.

        Ticks that have a row from before a crash keep that one.
        """
        if metrics.tick <= self._last_row:
            return
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
        self._metrics.append([_rounded(value) for value in row])
        self._separations = dict.fromkeys(self._drones, math.inf)

    def write_mesh(self, vertices: Vertices, faces: Faces, colours: Colours) -> None:
        """Write the map: (V, 3) metres in the world frame, (F, 3) vertex indices, (V, 3) sRGB. No files if empty.

        Raises:
            StorageError: the disk refuses it.
        """
        if not len(faces):
            return
        self._mesh_sha256 = mesh_sha256(vertices, faces)
        self._replace(MESH_PLY_FILE, ply(vertices, faces, colours))
        self._replace(MESH_GLB_FILE, glb(vertices, faces, colours))

    def write_phi(self, phi: NDArray[np.float32], field: VirtualField) -> None:
        """Write the importance (positions, directions) with its lattice.

        Raises:
            StorageError: the disk refuses it.
        """
        content = io.BytesIO()
        np.savez_compressed(
            content, phi=phi, xs=field.xs, ys=field.ys, zs=field.zs, directions=field.directions, allow_pickle=False
        )
        self._replace(PHI_FILE, content.getbuffer())

    def checkpoint(self) -> None:
        """Write trajectories and solver outcomes recorded so far: what is left of them if the process is killed.

        May be called from another thread than the rest; it takes some tens of milliseconds, more in long flights.
        """
        try:
            self._trajectories.write(self.path / TRAJECTORIES_FILE)
        except OSError as error:
            self._faults.refused(error)
        else:
            self._faults.took()

    def finish(
        self,
        final: Metrics,
        *,
        floor_baseline: Scores | None,
        phi_sha256: str,
        wall_time_s: float,
        exit_reason: str,
        feedback_update_s: float | None = None,
        pose_errors: PoseErrorFigures | None = None,
        unlocated: int = 0,
        contacts: Mapping[int, int] | None = None,
    ) -> Summary:
        """Write the last checkpoint and the summary; the mesh must have been written before.

        Raises:
            StorageError: the disk refuses something, and what it refused during the flight is still not written.
        """
        try:
            self._metrics.flush()
            self._trajectories.write(self.path / TRAJECTORIES_FILE)
        except OSError as error:
            raise _storage_error(self.path, error) from error
        flown, among_obstacles = self._trajectories, self._mission.flight.obstacles.enabled
        summary = Summary(
            mission=self._mission.name,
            seed=self._mission.seed,
            drones=len(self._drones),
            exit_reason=exit_reason,
            final=final,
            floor_baseline=floor_baseline,
            min_separation_m=self.min_separation_m,
            fallbacks=flown.fallbacks(),
            wall_time_s=wall_time_s,
            phi_sha256=phi_sha256,
            mesh_sha256=self._mesh_sha256,
            versions=versions(),
            feedback_update_s=feedback_update_s,
            pose_errors=pose_errors,
            unlocated=unlocated,
            contacts=contacts,
            min_obstacle_margin_m=flown.min_obstacle_margin_m(),
            fallbacks_among_obstacles=flown.fallbacks_among_obstacles() if among_obstacles else None,
        )
        text = json.dumps(summary.as_json(), indent=2, allow_nan=False) + "\n"
        self._replace(SUMMARY_FILE, text.encode())
        return summary

    def _replace(self, name: str, content: bytes | memoryview) -> None:
        try:
            replace_file(self.path / name, [content])
        except OSError as error:
            raise _storage_error(self.path / name, error) from error

    def _keep_mission(self) -> None:
        path = self.path / MISSION_FILE
        content = (self._mission.model_dump_json(indent=2) + "\n").encode()
        if not path.exists():
            replace_file(path, [content])
        elif path.read_bytes() != content:
            raise MissionError([f"{path}: this run folder belongs to another mission; take a new one: --run FOLDER"])


def versions() -> dict[str, str]:
    """Versions of Python and of the installed packages that may change a result."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue  # an optional part that is not installed cannot have changed anything
    return found


def _columns(drones: Sequence[int]) -> list[str]:
    return [
        "time_s", "tick", "importance", "f_score_visible", "f_score_exposed", "f_score_objects", "precision", "recall",
        "jumps", "keyframes", "min_separation_m", *(f"separation_{drone}_m" for drone in drones),
    ]  # fmt: skip


def _by_drone(counts: Mapping[int, int] | None) -> dict[str, int] | None:
    return None if counts is None else {str(drone): count for drone, count in counts.items()}


def _flat(scores: Scores | None) -> dict[str, float | None]:
    """Keys as in metrics.csv; precision and recall are those of the visible surface unless named otherwise."""
    names = ("visible", "exposed", "objects")
    parts = {name: getattr(scores, name) if scores else None for name in names}
    return {
        **{f"f_score_{name}": _rounded(part.f) if part else None for name, part in parts.items()},
        **{f"precision_{name}": _rounded(part.precision) if part else None for name, part in parts.items()},
        **{f"recall_{name}": _rounded(part.recall) if part else None for name, part in parts.items()},
    }


def _pose_figures(figures: PoseErrorFigures | None) -> dict[str, float | None]:
    names = ("rms_m", "max_m", "final_m", "yaw_rms_rad", "beyond")
    return {f"pose_error_{name}": _rounded(getattr(figures, name)) if figures else None for name in names}


def _rounded(value: float | None) -> float | None:
    """None for what there is not, NaN and infinity included: neither JSON nor every CSV reader knows them."""
    if value is None or not math.isfinite(value):
        return None
    return round(value, DECIMALS)


def _storage_error(path: Path, error: OSError) -> StorageError:
    return StorageError(f"{error.filename or path}: {error.strerror}")
