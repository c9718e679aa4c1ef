"""From a flight's keyframes to a map, with other settings or another method than in flight."""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ground_station.export.source import Source
from ground_station.keyframe_log import NoKeyframes
from ground_station.mapper import Mapper
from ground_station.rebuild.quality import Quality, assignments_of
from ground_station.reconstruction.reconstructor import Mesh, Statistics
from ground_station.replay.settings import with_settings
from protocol.errors import CovreconError
from protocol.field import VirtualField
from protocol.map_settings import Reconstruction
from protocol.mission import Mission


@dataclass(frozen=True, slots=True)
class Rebuilt:
    mesh: Mesh
    keyframes: int
    """All that were read."""
    unused: int
    """Of these, could not be read or did not help."""
    statistics: Statistics
    cpu_s: float
    """Processor time of all threads, from the first image to the last mesh."""
    wall_s: float


def rebuilding_mission(
    flown: Mission, quality: Quality, backend: str | None = None, settings: Sequence[str] = ()
) -> Mission:
    """``flown`` with what ``quality`` says, another backend if one is named, and ``settings`` above all.

    A flight that made no map gets the default backend.

    Raises:
        MissionError: one fault a line.
    """
    if backend is None and flown.reconstruction.backend == "none":
        backend = Reconstruction().backend
    chosen = [f"reconstruction.backend={backend}"] if backend is not None else []
    # Nobody flies by this map, so nobody asks where it changed.
    return with_settings(flown, [*assignments_of(quality), *chosen, *settings, "feedback.method=none"])


def rebuild(source: Source, mission: Mission) -> Rebuilt:
    """``mission`` as `rebuilding_mission` gives it; ``source`` tells how far it is.

    Raises:
        CovreconError: there are no keyframes, or they cannot be read.
        ReconstructionError: the map would not fit in memory.
    """
    mapper = Mapper(mission, VirtualField.of(mission.target), source.path, NoKeyframes())
    began_s, began_cpu_s = time.perf_counter(), time.process_time()
    count = 0
    for _, group in itertools.groupby(source.keyframes(), key=lambda keyframe: keyframe.tick):
        together = list(group)
        mapper.add(together)
        count += len(together)
    if not count:
        raise CovreconError(f"{source.path}: no keyframe was kept: it flew without cameras, or ended before the first")
    mesh = mapper.finish(scored=False).mesh
    return Rebuilt(
        mesh=mesh,
        keyframes=count,
        unused=mapper.refused,
        statistics=mapper.statistics,
        cpu_s=time.process_time() - began_cpu_s,
        wall_s=time.perf_counter() - began_s,
    )


def default_output(source: Path) -> Path:
    """Beside the flight's own map, or beside the recording."""
    return source / "rebuilt.ply" if source.is_dir() else source.with_name(f"{source.stem}-rebuilt.ply")
