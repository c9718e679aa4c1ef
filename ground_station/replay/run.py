"""A replay from the file to its outcome: what it came to, beside what the flight came to."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ground_station.keyframe_log import NoKeyframes
from ground_station.mapper import Mapper, MapUpdate
from ground_station.mesh_files import mesh_sha256
from ground_station.recording.entries import IntegratedTick, JumpRecord
from ground_station.recording.reader import Recording
from ground_station.recording.states import NewestStates
from ground_station.replay.comparison import Comparison
from ground_station.replay.engine import Replay
from ground_station.replay.settings import with_settings
from ground_station.results import METRICS_PERIOD_S, Metrics, RunFolder
from protocol.errors import RecordingError
from protocol.field import VirtualField
from protocol.mission import Mission


@dataclass(frozen=True, slots=True)
class Replayed:
    mission: Mission
    changed: bool
    """Whether the mission is not the one that was flown."""
    comparison: Comparison
    final: Metrics
    flown: Mapping[str, Any] | None
    """The flight's figures by the names of summary.json; None where the recording ends before the flight."""
    losses: Mapping[str, int]
    """Messages by channel that the flight's recorder had to drop: they may be why a replay differs."""
    page: Path | None
    """The report, if a folder was written."""


@dataclass(frozen=True, slots=True)
class Outline:
    """What has to be known of a recording before it is replayed."""

    last_tick: int
    jumped: frozenset[int]
    """Ticks of the looks at the map that made phi jump."""


def replay(
    path: Path,
    settings: Sequence[str],
    out: Path | None,
    *,
    progress: Callable[[int, int], None],
    now_s: Callable[[], float],
) -> Replayed:
    """Replay the recording at ``path``, with ``settings`` like ``feedback.kappa=0.5`` changed.

    ``out`` becomes a run's folder, with report, of what the replay came to. F-scores are there if the truth is beside
    the recording, as in a run's folder. ``progress`` is told the tick, and the last one; ``now_s`` is a clock.

    Raises:
        RecordingError: it cannot be read, or does not begin with the flight.
        MissionError: a setting that cannot be, or cannot be changed any more; ``out`` holds a flight already.
        StorageError: the disk refuses ``out``.
    """
    began_s = now_s()
    recording = Recording.open(path)
    mission = with_settings(recording.mission, settings)
    outline = survey(recording)
    mapper = Mapper(mission, VirtualField.of(mission.target), path.parent, NoKeyframes())
    engine = Replay(recording.mission, mission, mapper, outline.jumped)
    folder = _Folder(out, mission, recording) if out is not None else None
    try:
        for entry in recording.inputs():
            engine.feed(entry)
            if isinstance(entry, IntegratedTick):
                progress(entry.tick, outline.last_tick)
                if folder is not None:
                    folder.record(entry, engine)
        result = engine.finish()
        flown = recording.summary()
        if flown is not None:
            engine.comparison.end(engine.tick, flown, engine.field.sha256, _hash(result))
        page = None
        if folder is not None:
            page = folder.finish(engine, result, mapper, f"replay of {path.name}", now_s() - began_s)
    finally:
        if folder is not None:
            folder.close()
    return Replayed(
        mission, mission != recording.mission, engine.comparison, engine.metrics(), flown, recording.losses(), page
    )


def survey(recording: Recording) -> Outline:
    """Raises `RecordingError` unless it begins with the flight's first tick."""
    first = last = -1
    jumped = set()
    for entry in recording.inputs():
        if isinstance(entry, IntegratedTick):
            first, last = (entry.tick if first < 0 else first), entry.tick
        elif isinstance(entry, JumpRecord):
            jumped.add(entry.look)
    if first < 0:
        raise RecordingError(f"{recording.path}: holds no tick that was flown")
    if first > 0 or recording.resumed:
        raise RecordingError(
            f"{recording.path}: begins at tick {first}, when the ground station was started again: phi and the map of "
            "before are not in it. Replay the recording before it"
        )
    return Outline(last, frozenset(jumped))


class _Folder:
    """The run's folder that a replay leaves."""

    def __init__(self, path: Path, mission: Mission, recording: Recording) -> None:
        self._run = RunFolder(path, mission)
        self._states = NewestStates({drone.id: recording.states(drone.id) for drone in mission.drones})
        self._tick_s = mission.tick_s
        self._row_ticks = max(1, round(METRICS_PERIOD_S / mission.tick_s))

    def record(self, entry: IntegratedTick, engine: Replay) -> None:
        poses = dict(zip(entry.ids, entry.poses.tolist(), strict=True))
        self._run.record_tick(entry.tick, entry.tick * self._tick_s, poses, self._states.at(entry.tick))
        if entry.tick % self._row_ticks == 0:
            self._run.record_metrics(engine.metrics())

    def finish(self, engine: Replay, result: MapUpdate, mapper: Mapper, reason: str, wall_time_s: float) -> Path:
        from ground_station.report import write_report

        mesh, final = result.mesh, engine.metrics()
        self._run.record_metrics(final)
        self._run.write_mesh(mesh.vertices, mesh.faces, mesh.colors)
        self._run.write_phi(engine.field.phi, engine.field.field)
        self._run.finish(
            final,
            floor_baseline=mapper.floor_scores(),
            phi_sha256=engine.field.sha256,
            wall_time_s=wall_time_s,
            feedback_update_s=mapper.feedback_update_s,
            exit_reason=reason,
        )
        return write_report(self._run.path)

    def close(self) -> None:
        self._run.close()


def _hash(result: MapUpdate) -> str | None:
    """As in summary.json: None for no map."""
    return mesh_sha256(result.mesh.vertices, result.mesh.faces) if len(result.mesh.faces) else None
