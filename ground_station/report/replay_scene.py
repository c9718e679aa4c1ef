"""What the replay page shows at which moment: pure, and bounded however long the flight was."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ground_station.report.coarse_mesh import coarse_mesh
from ground_station.report.run_data import FieldMoment, MapMoment, Run
from protocol.geometry import Floats

Moment = TypeVar("Moment", MapMoment, FieldMoment)

FRAMES = 500
TRAIL_PIECES = 50
"""Of each drone; a piece appears when it is flown."""
LONGEST_PLAY_S = 90.0
"""A longer mission is played faster."""
TRIANGLES_AT_THE_END, TRIANGLES_BEFORE = 60_000, 24_000
POINTS = 8_000
HIDDEN_BELOW = 0.1
"""Importance of a position that is not worth a point any more; in the beginning all have 1."""


@dataclass(frozen=True, slots=True)
class Frame:
    """What changes at one moment; None where nothing does."""

    time_s: float
    caption: str
    poses: Floats
    """(D, 5); NaN before a drone was heard, its last pose while it is not heard."""
    trails: Sequence[NDArray[np.float32]]
    """The newest piece of each drone's path, (points, 3); empty unless pieces are due."""
    map: MapMoment | None
    field: FieldMoment | None


@dataclass(frozen=True, slots=True)
class Scene:
    drones: Sequence[int]
    frames: Sequence[Frame]
    speed: float
    """Mission time per time of play."""


def replay_scene(run: Run) -> Scene | None:
    """None if no drone was recorded."""
    flight = run.flight
    if flight is None or not np.isfinite(flight.poses).any():
        return None
    shown = np.unique(np.linspace(0, len(flight.time_s) - 1, FRAMES).astype(np.int64))
    time_s, poses = flight.time_s[shown], _last_known(flight.poses)[shown]
    maps, fields = _by_frame(time_s, _maps(run)), _by_frame(time_s, [_thinned(each) for each in run.history.fields])
    frames = [
        Frame(
            time_s=float(time_s[number]),
            caption=_caption(run, float(time_s[number])),
            poses=poses[number],
            trails=[_path(poses[trail, index, :3]) for index in range(len(flight.drones)) if trail is not None],
            map=maps.get(number),
            field=fields.get(number),
        )
        for number, trail in enumerate(_trails(len(shown)))
    ]
    return Scene(flight.drones.tolist(), frames, speed=max(1.0, float(time_s[-1] - time_s[0]) / LONGEST_PLAY_S))


def _last_known(poses: Floats) -> Floats:
    """(T, D, 5) with gaps filled by the pose before."""
    known = np.isfinite(poses[:, :, 0])
    newest = np.maximum.accumulate(np.where(known, np.arange(len(poses))[:, None], 0), axis=0)
    return np.asarray(np.take_along_axis(poses, newest[:, :, None], axis=0))


def _trails(frames: int) -> Iterator[slice | None]:
    """For each frame the frames that the piece of trail spans which appears with it; None if none does."""
    step = -(-frames // TRAIL_PIECES)
    for number in range(frames):
        ends = number > 0 and (number % step == 0 or number == frames - 1)
        yield slice((number - 1) // step * step, number + 1) if ends else None


def _path(positions: Floats) -> NDArray[np.float32]:
    return positions[np.isfinite(positions[:, 0])].astype(np.float32)


def _by_frame(time_s: Floats, moments: Sequence[Moment]) -> dict[int, Moment]:
    """Each by the number of the first frame that is not before it, or of the last frame; the newest counts."""
    due = np.minimum(np.searchsorted(time_s, [moment.time_s for moment in moments]), len(time_s) - 1)
    return dict(zip(due.tolist(), moments, strict=True))


def _maps(run: Run) -> list[MapMoment]:
    """As they grew, if that was recorded; else the final one, from the start on."""
    maps = [MapMoment(each.time_s, coarse_mesh(each.mesh, TRIANGLES_BEFORE)) for each in run.history.maps]
    if run.mesh is not None:
        maps.append(MapMoment(np.inf if maps else -np.inf, coarse_mesh(run.mesh, TRIANGLES_AT_THE_END)))
    return maps


def _thinned(moment: FieldMoment) -> FieldMoment:
    """Without the positions that are not important any more, and of a large field every so many-th."""
    step = -(-len(moment.importance) // POINTS)
    kept = np.flatnonzero(moment.importance >= HIDDEN_BELOW)
    kept = kept[kept % step == 0]
    return FieldMoment(moment.time_s, moment.positions[kept], moment.importance[kept])


def _caption(run: Run, time_s: float) -> str:
    times = run.curves.get("time_s", np.empty(0))
    row = int(np.searchsorted(times, time_s, side="right")) - 1
    importance = f"   J {run.curves['importance'][row]:.2f}" if row >= 0 else ""
    return f"{time_s:.0f} s{importance}"
