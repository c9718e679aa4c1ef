"""What is exported, whether it lies in a run's folder or in a recording. Nothing of either is ever changed.

A run may still be going on: what a process is writing at the moment is read as far as it is whole.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ground_station.reconstruction.reconstructor import Mesh
from protocol.field import VirtualField
from protocol.geometry import Floats
from protocol.messages import Keyframe
from protocol.mission import Mission

Progress: TypeAlias = Callable[[str, int, int], None]
"""Told what is being done, how far it is, and out of how much."""


def unwatched(what: str, done: int, total: int) -> None:
    """The progress of whoever does not care."""


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """What each drone flew, tick by tick."""

    drones: tuple[int, ...]
    tick: NDArray[np.int64]
    """(T,)"""
    time_s: Floats
    """(T,) mission time."""
    poses: Floats
    """(T, D, 5) x, y, z in metres, camera yaw and pitch in radians; NaN where a drone was not heard."""
    columns: Mapping[str, NDArray[Any]]
    """What else is known, (T, D) each, by its name with the unit (`ground_station.results`)."""

    @classmethod
    def of(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """Of what `ground_station.trajectories` keeps."""
        drones, tick, time_s, poses = (arrays[name] for name in ("drones", "tick", "time_s", "poses"))
        columns = {name: array for name, array in arrays.items() if array.shape == (len(tick), len(drones))}
        return cls(tuple(drones.tolist()), tick, time_s, poses, columns)


@dataclass(frozen=True, slots=True, eq=False)
class Importance:
    """phi at one moment."""

    field: VirtualField
    phi: NDArray[np.float32]
    """(positions, directions)"""
    moment: str
    """Which moment that is, in words."""


class Source(Protocol):
    """Each part raises CovreconError naming the file if it is missing or cannot be read."""

    @property
    def path(self) -> Path:
        """The folder or the file."""
        ...

    @property
    def mission(self) -> Mission: ...

    def keyframes(self) -> Iterator[Keyframe]:
        """In the order in which the ground station took them in. Bytes that cannot be read are told and left out."""
        ...

    def flight(self) -> Flight: ...

    def mesh(self) -> Mesh:
        """The newest map, with at least one triangle."""
        ...

    def importance(self) -> Importance: ...


def open_source(path: Path, progress: Progress = unwatched) -> Source:
    """A run's folder, or a recording; ``progress`` is told how far reading it is.

    Raises:
        MissionError: there is no such thing, or it holds no readable mission.
        RecordingError: a recording that cannot be read.
    """
    if path.is_dir():
        from ground_station.export.run_folder import RunFolderSource

        return RunFolderSource(path, progress)
    from ground_station.export.recorded import RecordedSource

    return RecordedSource(path, progress)
