"""The reconstructor that has learnt what rooms look like: fragments of keyframes through a network, into the volume.

Every few keyframes of a drone become a fragment, with the newest keyframes of the team that show the same place, and
what the network says of it is averaged into the map. What is done when depends on the keyframes given alone.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from ground_station.reconstruction.admission import Admission
from ground_station.reconstruction.fusion import Volume
from ground_station.reconstruction.learned.fragment import (
    FINE_M,
    REACH_M,
    VIEWS_MIN,
    choose_views,
    middle_of,
    place_window,
    projection,
    seen_points,
    shows,
)
from ground_station.reconstruction.learned.prediction import Photograph, Predictor
from ground_station.reconstruction.learned.weights import SHIPPED, load_network
from ground_station.reconstruction.ledger import Ledger
from ground_station.reconstruction.reconstructor import PATIENCE_S, Keyframe, Mesh, Outcome, State, Statistics
from ground_station.reconstruction.surface_nets import extract_mesh
from ground_station.reconstruction.views import View, shrink, to_grey
from protocol.mission import Mission
from protocol.obstacle_grid import Cells, ObstacleGrid

GROUP: Final = 4
"""Keyframes of one drone from which a fragment is made: half a metre of its path, a fifth of what a window shows."""
KEPT: Final = 128
"""Newest keyframes that a fragment is chosen from; with their features 85 MB."""
WEIGHT_MIN: Final = 0.4
"""Weight from which a voxel is part of the map: one fragment of eight views that is sure of it, or two of four."""


@dataclass(frozen=True, slots=True, eq=False)
class _Entry:
    drone: int
    sequence: int
    tick: int
    view: View
    photograph: Photograph


class LearnedReconstructor:
    """Implements `reconstructor.Reconstructor`."""

    def __init__(self, mission: Mission) -> None:
        """Raises `ReconstructionError` without torch, or if the mission's weights do not fit."""
        settings = mission.reconstruction
        self._predictor = Predictor(
            load_network(Path(settings.learned.weights) if settings.learned.weights else SHIPPED)
        )
        self._box = mission.target
        sweep = mission.sweep_intrinsics()
        self._width, self._height = sweep.width, sweep.height
        self._size = self._predictor.size(mission.camera.width_px, mission.camera.height_px)
        self._patience = round(PATIENCE_S / mission.tick_s)
        self._volume = Volume(mission.target, FINE_M, REACH_M)
        self._admission = Admission(mission)
        self._kept: deque[_Entry] = deque(maxlen=KEPT)
        self._waiting: dict[int, list[_Entry]] = {}
        self._ledger = Ledger()

    def add(self, keyframes: Sequence[Keyframe]) -> tuple[Outcome, ...]:
        outcomes = []
        for keyframe in keyframes:
            outcomes.append(self._admit(keyframe))
            if len(self._waiting.get(keyframe.drone, ())) >= GROUP:
                self._reconstruct(keyframe.drone)
        now = max(self._admission.newest.values(), default=0)
        for drone, entries in sorted(self._waiting.items()):
            if entries and now - entries[0].tick >= self._patience:
                self._reconstruct(drone)
        return (*outcomes, *self._ledger.take())

    def flush(self) -> tuple[Outcome, ...]:
        for drone in sorted(self._waiting):
            self._reconstruct(drone)
        return self._ledger.take()

    def mesh(self) -> Mesh:
        return extract_mesh(self._volume, WEIGHT_MIN)

    def free_cells(self, grid: ObstacleGrid) -> Cells:
        """What is vouched for: what a network takes for empty is a guess, and no drone shall fly into a guess."""
        return grid.vouched.copy()

    def statistics(self) -> Statistics:
        return self._ledger.statistics(
            self._volume.size_bytes + sum(entry.photograph.size_bytes for entry in self._kept)
        )

    @property
    def lookback(self) -> int:
        return KEPT

    def state(self) -> State:
        waiting = [(entry.drone, entry.tick) for entries in self._waiting.values() for entry in entries]
        return {
            **self._volume.state(),
            "waiting": np.array(waiting, np.int64).reshape(-1, 2),
            "newest": self._admission.state(),
            **self._ledger.state(),
        }

    def restore(self, state: State, recent: Iterable[Keyframe]) -> None:
        self._volume.restore(state)
        for keyframe in recent:
            self._admit(keyframe)
        waiting = set(map(tuple, state["waiting"].tolist()))
        for drone, entries in self._waiting.items():
            self._waiting[drone] = [entry for entry in entries if (drone, entry.tick) in waiting]
        self._admission.restore(state["newest"])
        self._ledger.restore(state, waiting=sum(map(len, self._waiting.values())))

    def _admit(self, keyframe: Keyframe) -> Outcome:
        """Keep what later steps need of a keyframe, unless it is of no use."""
        self._ledger.received += 1
        color = shrink(keyframe.image, self._width, self._height)
        camera = keyframe.intrinsics.scaled_to(self._width, self._height)
        view = View(to_grey(color), keyframe.position, keyframe.rotation, camera)
        span = self._admission.examine(keyframe, view)
        if isinstance(span, str):
            return self._ledger.refuse(keyframe, span)
        photograph = self._predictor.look(shrink(keyframe.image, *self._size))
        entry = _Entry(keyframe.drone, keyframe.sequence, keyframe.tick, view, photograph)
        self._kept.append(entry)
        self._waiting.setdefault(keyframe.drone, []).append(entry)
        return Outcome(keyframe.drone, keyframe.sequence, "waiting")

    def _reconstruct(self, drone: int) -> None:
        """Make a fragment of what waits of a drone, and of the team's newest that show what its newest shows."""
        group = self._waiting.pop(drone, [])
        if not group:
            return
        newest = group[-1]
        entries = [newest, *(entry for entry in reversed(self._kept) if entry is not newest)]
        fragment = [entries[place] for place in choose_views([entry.view for entry in entries], self._box)]
        if len(fragment) < VIEWS_MIN:
            for entry in group:
                self._ledger.note(self._ledger.refuse(entry, "no_overlap"))
            return
        views = [entry.view for entry in fragment]
        window = place_window(middle_of(views, self._box), self._volume.origin, self._volume.distance.shape)
        corner = self._volume.origin + FINE_M * np.array(window.first)
        projections = np.stack([projection(view) for view in views])
        block = self._predictor.predict([entry.photograph for entry in fragment], projections, corner, window)
        if not block.surface:
            for entry in group:
                self._ledger.note(self._ledger.refuse(entry, "no_depth"))
            return
        self._volume.blend(window.first, block.distance, block.weight, block.color)
        shown = shows([entry.view for entry in group], seen_points(newest.view, self._box))
        for entry, is_part in zip(group, shown.tolist(), strict=True):
            known = is_part or entry is newest
            self._ledger.note(self._ledger.fuse(entry) if known else self._ledger.refuse(entry, "no_overlap"))
