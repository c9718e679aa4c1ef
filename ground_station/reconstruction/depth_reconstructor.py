"""Measured depth straight into the volume: for drones with depth cameras, and the best that any method can do.

A keyframe waits for the next one of its drone, so that a wrong pose or scale is found before it is in the map: its
depth must be that of other views. Then all of it is fused, also what no other view shows.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ground_station.reconstruction.depth_check import COMPARED_MIN, NEAREST_M, Measured, fault_of
from ground_station.reconstruction.depth_range import depth_range
from ground_station.reconstruction.free_cells import free_cells
from ground_station.reconstruction.fusion import Volume
from ground_station.reconstruction.ledger import Ledger
from ground_station.reconstruction.reconstructor import PATIENCE_S, Keyframe, Mesh, Outcome, State, Statistics
from ground_station.reconstruction.source_views import ViewIndex
from ground_station.reconstruction.surface_nets import extract_mesh
from ground_station.reconstruction.views import View, shrink, to_grey
from protocol.mission import Mission
from protocol.obstacle_grid import Cells, ObstacleGrid

LOOK_AHEAD: Final = 1
"""Later keyframes of the same drone that a keyframe waits for."""
VIEWS_KEPT: Final = 512
"""Newest keyframes that others may be compared with."""
BYTES_PER_PIXEL: Final = 8
"""Of a kept keyframe: grey, color and depth."""
INSIDE_MIN: Final = 0.01
"""Least share of the pixels whose surface lies in the box to be mapped."""
WEIGHT_MIN: Final = 0.3
"""Weight from which a voxel is part of the map, as of the plane sweep."""


@dataclass(frozen=True, slots=True, eq=False)
class _Entry:
    drone: int
    sequence: int
    tick: int
    rank: int
    """Number of the drone's keyframes that were taken in before it."""
    measured: Measured
    color: NDArray[np.uint8]
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
        self._ledger = Ledger()

    def add(self, keyframes: Sequence[Keyframe]) -> tuple[Outcome, ...]:
        outcomes = [self._admit(keyframe) for keyframe in keyframes]
        return (*outcomes, *self._decide())

    def flush(self) -> tuple[Outcome, ...]:
        return tuple(self._decide(everything=True))

    def mesh(self) -> Mesh:
        return extract_mesh(self._volume, WEIGHT_MIN)

    def free_cells(self, grid: ObstacleGrid) -> Cells:
        return free_cells(self._volume, WEIGHT_MIN, grid)

    def statistics(self) -> Statistics:
        kept = sum(BYTES_PER_PIXEL * entry.measured.depth.size for entry in self._kept if entry)
        return self._ledger.statistics(self._volume.size_bytes + kept)

    @property
    def lookback(self) -> int:
        return VIEWS_KEPT

    def state(self) -> State:
        return {
            **self._volume.state(),
            "waiting": np.array([(entry.drone, entry.tick) for entry in self._waiting], np.int64).reshape(-1, 2),
            "newest": np.array(sorted(self._newest.items()), np.int64).reshape(-1, 2),
            **self._ledger.state(),
        }

    def restore(self, state: State, recent: Iterable[Keyframe]) -> None:
        self._volume.restore(state)
        for keyframe in recent:
            self._admit(keyframe)
        waiting = set(map(tuple, state["waiting"].tolist()))
        self._waiting = [entry for entry in self._waiting if (entry.drone, entry.tick) in waiting]
        self._newest.update(state["newest"].tolist())
        self._ledger.restore(state, waiting=len(self._waiting))

    def _admit(self, keyframe: Keyframe) -> Outcome:
        """Keep a keyframe until others can confirm it, unless it is of no use."""
        self._ledger.received += 1
        if keyframe.depth is None:
            return self._ledger.refuse(keyframe, "no_depth")
        depth = np.where(keyframe.depth < NEAREST_M, np.float32(0), keyframe.depth)
        last = self._newest_depth.get(keyframe.drone)
        if keyframe.tick <= self._newest.get(keyframe.drone, -1) or (last is not None and np.array_equal(depth, last)):
            return self._ledger.refuse(keyframe, "repeated")
        height, width = depth.shape
        if np.count_nonzero(depth) < COMPARED_MIN * depth.size:
            return self._ledger.refuse(keyframe, "no_depth")
        color = shrink(keyframe.image, width, height)
        camera = keyframe.intrinsics.scaled_to(width, height)
        view = View(to_grey(color), keyframe.position, keyframe.rotation, camera)
        measured = Measured(view, depth)
        if not self._shows_the_box(measured):
            return self._ledger.refuse(keyframe, "off_target")
        typical = float(np.median(depth[depth > 0]))
        rank = self._taken[keyframe.drone]
        entry = _Entry(keyframe.drone, keyframe.sequence, keyframe.tick, rank, measured, color, typical)
        self._taken[keyframe.drone] += 1
        self._newest[keyframe.drone] = keyframe.tick
        self._newest_depth[keyframe.drone] = depth
        self._kept[self._index.add(view)] = entry
        self._waiting.append(entry)
        return Outcome(keyframe.drone, keyframe.sequence, "waiting")

    def _shows_the_box(self, measured: Measured) -> bool:
        margin = self._settings.truncation_m
        if depth_range(measured.view, self._box, margin) is None:
            return False
        points = measured.surface()
        inside = (points > np.array(self._box.lower_m) - margin) & (points < np.array(self._box.upper_m) + margin)
        return bool(np.count_nonzero(inside.all(axis=1)) >= INSIDE_MIN * measured.depth.size)

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
        view, depth = entry.measured.view, entry.measured.depth
        slots = self._index.sources(view, entry.typical, self._settings.sources)
        fault = fault_of(entry.measured, [other.measured for slot in slots if (other := self._kept[slot]) is not None])
        if fault is not None:
            return self._ledger.refuse(entry, fault)
        weight = np.maximum(depth, np.float32(self._settings.nearest_m)) ** np.float32(-2)
        self._volume.integrate(view, depth, weight, entry.color)
        return self._ledger.fuse(entry)
