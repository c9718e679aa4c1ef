"""Measured depth straight into the volume: for drones with depth cameras, and the best that any method can do.

A keyframe waits for the next one of its drone, so that a wrong pose or scale is found before it is in the map: its
depth must be that of other views. Then all of it is fused, also what no other view shows.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, get_args

import numpy as np
from numpy.typing import NDArray

from ground_station.reconstruction.consistency import TOLERANCE
from ground_station.reconstruction.depth_range import depth_range
from ground_station.reconstruction.fusion import Volume
from ground_station.reconstruction.reconstructor import Keyframe, Mesh, Outcome, Refusal, State, Statistics
from ground_station.reconstruction.source_views import ViewIndex
from ground_station.reconstruction.surface_nets import extract_mesh
from ground_station.reconstruction.views import View, shrink, to_grey
from protocol.mission import Mission

LOOK_AHEAD: Final = 1
"""Later keyframes of the same drone that a keyframe waits for."""
PATIENCE_S: Final = 3.0
"""Mission time after which a hovering drone's last keyframe is used without a later one."""
VIEWS_KEPT: Final = 512
"""Newest keyframes that others may be compared with."""
NEAREST_M: Final = 0.05
"""What is nearer is the camera's own fault: a finger, or metres where millimetres were meant."""
KNOWN_MIN: Final = 0.05
"""Least share of the pixels with depth, and of those that others can be compared in."""
INSIDE_MIN: Final = 0.01
"""Least share of the pixels whose surface lies in the box to be mapped."""
CONFIRMED_MIN: Final = 0.4
"""Least share of the compared depths that others confirm, as of the plane sweep."""
WEIGHT_MIN: Final = 0.3
"""Weight from which a voxel is part of the map, as of the plane sweep."""


@dataclass(frozen=True, slots=True, eq=False)
class _Entry:
    drone: int
    sequence: int
    tick: int
    rank: int
    """Number of the drone's keyframes that were taken in before it."""
    view: View
    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    typical: float
    """m: median of its depths."""


class DepthReconstructor:
    """Implements `reconstructor.Reconstructor`."""

    def __init__(self, mission: Mission) -> None:
        self._settings = mission.reconstruction
        self._box = mission.target
        self._patience = round(PATIENCE_S / mission.tick_s)
        self._volume = Volume(mission.target, self._settings.voxel_m, self._settings.truncation_m)
        self._index = ViewIndex(VIEWS_KEPT)
        self._kept: list[_Entry | None] = [None] * VIEWS_KEPT
        self._waiting: list[_Entry] = []
        self._taken: Counter[int] = Counter()
        self._newest: dict[int, int] = {}  # tick
        self._newest_depth: dict[int, NDArray[np.float32]] = {}
        self._received = 0
        self._fused = 0
        self._refused: Counter[Refusal] = Counter()

    def add(self, keyframes: Sequence[Keyframe]) -> tuple[Outcome, ...]:
        outcomes = [self._admit(keyframe) for keyframe in keyframes]
        return (*outcomes, *self._decide())

    def flush(self) -> tuple[Outcome, ...]:
        return tuple(self._decide(everything=True))

    def mesh(self) -> Mesh:
        return extract_mesh(self._volume, WEIGHT_MIN)

    def statistics(self) -> Statistics:
        kept = sum(entry.depth.nbytes + entry.color.nbytes + entry.view.grey.nbytes for entry in self._kept if entry)
        return Statistics(
            received=self._received,
            fused=self._fused,
            waiting=len(self._waiting),
            refused=dict(self._refused),
            memory_bytes=self._volume.size_bytes + kept,
        )

    @property
    def lookback(self) -> int:
        return VIEWS_KEPT

    def state(self) -> State:
        return {
            **self._volume.state(),
            "waiting": np.array([(entry.drone, entry.tick) for entry in self._waiting], np.int64).reshape(-1, 2),
            "newest": np.array(sorted(self._newest.items()), np.int64).reshape(-1, 2),
            "fused": np.array(self._fused),
            "refused": np.array([self._refused[reason] for reason in get_args(Refusal)]),
        }

    def restore(self, state: State, recent: Iterable[Keyframe]) -> None:
        self._volume.restore(state)
        for keyframe in recent:
            self._admit(keyframe)
        waiting = set(map(tuple, state["waiting"].tolist()))
        self._waiting = [entry for entry in self._waiting if (entry.drone, entry.tick) in waiting]
        self._newest.update(state["newest"].tolist())
        self._fused = int(state["fused"])
        self._refused = +Counter(dict(zip(get_args(Refusal), state["refused"].tolist(), strict=True)))  # without zeros
        self._received = self._fused + self._refused.total() + len(self._waiting)

    def _admit(self, keyframe: Keyframe) -> Outcome:
        """Keep a keyframe until others can confirm it, unless it is of no use."""
        self._received += 1
        if keyframe.depth is None:
            return self._refuse(keyframe, "no_depth")
        depth = np.where(keyframe.depth < NEAREST_M, np.float32(0), keyframe.depth)
        last = self._newest_depth.get(keyframe.drone)
        if keyframe.tick <= self._newest.get(keyframe.drone, -1) or (last is not None and np.array_equal(depth, last)):
            return self._refuse(keyframe, "repeated")
        height, width = depth.shape
        if np.count_nonzero(depth) < KNOWN_MIN * depth.size:
            return self._refuse(keyframe, "no_depth")
        color = shrink(keyframe.image, width, height)
        camera = keyframe.intrinsics.scaled_to(width, height)
        view = View(to_grey(color), keyframe.position, keyframe.rotation, camera)
        if not self._shows_the_box(view, depth):
            return self._refuse(keyframe, "off_target")
        typical = float(np.median(depth[depth > 0]))
        rank = self._taken[keyframe.drone]
        entry = _Entry(keyframe.drone, keyframe.sequence, keyframe.tick, rank, view, color, depth, typical)
        self._taken[keyframe.drone] += 1
        self._newest[keyframe.drone] = keyframe.tick
        self._newest_depth[keyframe.drone] = depth
        self._kept[self._index.add(view)] = entry
        self._waiting.append(entry)
        return Outcome(keyframe.drone, keyframe.sequence, "waiting")

    def _shows_the_box(self, view: View, depth: NDArray[np.float32]) -> bool:
        margin = self._settings.truncation_m
        if depth_range(view, self._box, margin) is None:
            return False
        points = _surface(view, depth)
        inside = (points > np.array(self._box.lower_m) - margin) & (points < np.array(self._box.upper_m) + margin)
        return bool(np.count_nonzero(inside.all(axis=1)) >= INSIDE_MIN * depth.size)

    def _decide(self, everything: bool = False) -> list[Outcome]:
        """Fuse or refuse what need not wait any longer, in the order in which it came."""
        now = max(self._newest.values(), default=0)

        def is_due(entry: _Entry) -> bool:
            followed = self._taken[entry.drone] - 1 - entry.rank >= LOOK_AHEAD
            return everything or followed or now - entry.tick >= self._patience

        due = [entry for entry in self._waiting if is_due(entry)]
        self._waiting = [entry for entry in self._waiting if not is_due(entry)]
        return [self._fuse(entry) for entry in due]

    def _fuse(self, entry: _Entry) -> Outcome:
        slots = self._index.sources(entry.view, entry.typical, self._settings.sources)
        others = [(other.view, other.depth) for slot in slots if (other := self._kept[slot]) is not None]
        fault = fault_of(entry.view, entry.depth, others)
        if fault is not None:
            return self._refuse(entry, fault)
        weight = np.maximum(entry.depth, np.float32(self._settings.nearest_m)) ** np.float32(-2)
        self._volume.integrate(entry.view, entry.depth, weight, entry.color)
        self._fused += 1
        return Outcome(entry.drone, entry.sequence, "fused")

    def _refuse(self, keyframe: Keyframe | _Entry, reason: Refusal) -> Outcome:
        self._refused[reason] += 1
        return Outcome(keyframe.drone, keyframe.sequence, "refused", reason)


def fault_of(
    view: View, depth: NDArray[np.float32], others: Sequence[tuple[View, NDArray[np.float32]]]
) -> Refusal | None:
    """Why ``depth`` (H, W) of ``view`` cannot be believed, by what ``others`` measured; None if it can."""
    if not others:
        return "no_overlap"
    points = _surface(view, depth)
    ratios = np.stack([_ratios(points, *other) for other in others])
    compared = np.count_nonzero((ratios > 0).any(axis=0))
    if compared < KNOWN_MIN * depth.size:
        return "no_overlap"
    if np.count_nonzero((np.abs(ratios - 1) < TOLERANCE).any(axis=0)) >= CONFIRMED_MIN * compared:
        return None
    factor = np.median(ratios[ratios > 0])
    alike = np.count_nonzero((np.abs(ratios / factor - 1) < TOLERANCE).any(axis=0))
    return "wrong_scale" if alike >= CONFIRMED_MIN * compared else "no_depth"


def _surface(view: View, depth: NDArray[np.float32]) -> NDArray[np.float64]:
    """(N, 3) m, world: what the pixels with depth show."""
    rows, columns = np.nonzero(depth)
    pixels = np.column_stack([columns, rows, np.ones(rows.size)])
    rays = pixels @ np.linalg.inv(view.calibration).T @ view.rotation.T  # one metre of depth each
    points: NDArray[np.float64] = view.position + depth[rows, columns, None] * rays
    return points


def _ratios(points: NDArray[np.float64], view: View, depth: NDArray[np.float32]) -> NDArray[np.float64]:
    """(N,) what ``view`` measured where it should see ``points`` (N, 3), as a multiple of their depth; 0: nothing."""
    height, width = depth.shape
    seen = (points - view.position) @ view.rotation @ view.calibration.T
    ahead = np.maximum(seen[:, 2], NEAREST_M)
    columns, rows = (np.rint(seen[:, axis] / ahead).clip(-1, size) for axis, size in ((0, width), (1, height)))
    within = (seen[:, 2] > NEAREST_M) & (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    found = np.zeros(len(points))
    found[within] = depth[rows[within].astype(int), columns[within].astype(int)] / ahead[within]
    return found
