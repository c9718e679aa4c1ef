"""A run as arrays, with every part but the mission optional: runs crash, and not all have a map or a truth."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from protocol.geometry import Floats
from protocol.messages import Event
from protocol.mission import Mission

Curves: TypeAlias = Mapping[str, Floats]
"""Columns of metrics.csv by name, each (rows,); NaN where a cell is empty. No rows if the file is missing."""


@dataclass(frozen=True, slots=True)
class Flight:
    """What trajectories.npz holds, (T,) or (ticks T, drones D); units in `ground_station.results`."""

    drones: NDArray[np.int64]
    """(D,) ids."""
    time_s: Floats
    poses: Floats
    """(T, D, 5); NaN where a drone was not heard."""
    solve_time_s: Floats
    slack: Floats
    separation_margin_m2: Floats
    region_margin_m: Floats
    pitch_margin_rad2: Floats
    obstacle_margin_m: Floats
    position_sd_m: Floats
    """Standard deviation that the drone told of its position; NaN throughout in files of earlier versions."""
    fallback: NDArray[np.str_]
    """Why the drone braked, or ""."""
    mode: NDArray[np.str_]
    """"" before the drone was heard, and throughout in files of earlier versions."""
    battery: Floats


@dataclass(frozen=True, slots=True)
class Mesh:
    vertices: NDArray[np.float32]
    """(V, 3) metres, world frame."""
    faces: NDArray[np.int32]
    """(F, 3)"""
    colours: NDArray[np.uint8]
    """(V, 3) sRGB."""


@dataclass(frozen=True, slots=True)
class MapMoment:
    """The map as it was."""

    time_s: float
    mesh: Mesh


@dataclass(frozen=True, slots=True)
class FieldMoment:
    """phi as it was."""

    time_s: float
    positions: NDArray[np.float32]
    """(n, 3) metres."""
    importance: NDArray[np.float32]
    """(n,) mean over the directions of a position, 0 to 1."""


@dataclass(frozen=True, slots=True)
class History:
    """What only a recording, or the end of a run, can tell; each in the order of time."""

    maps: Sequence[MapMoment] = ()
    fields: Sequence[FieldMoment] = ()
    events: Sequence[Event] = ()
    notes: Sequence[str] = ()
    """Why something is not told."""


@dataclass(frozen=True, slots=True)
class Run:
    mission: Mission
    curves: Curves
    flight: Flight | None
    mesh: Mesh | None
    summary: Mapping[str, Any] | None
    """summary.json; None if the run was cut short."""
    history: History = field(default_factory=History)

    def last(self, column: str) -> float:
        """Newest value of a column of metrics.csv that is not empty, NaN if there is none."""
        known = self.curves.get(column, np.empty(0))
        known = known[np.isfinite(known)]
        return float(known[-1]) if len(known) else math.nan


def flight_of(arrays: Mapping[str, NDArray[Any]]) -> Flight:
    """``arrays`` by the names of trajectories.npz; others than those of `Flight` may be among them."""
    return Flight(**{entry.name: arrays[entry.name] for entry in fields(Flight)})
