"""The default reconstructor: depth from images alone, on the CPU, as fast as the drones photograph.

A keyframe is compared with views before and after it on its drone's path and with any other drone's. So it waits for
`LOOK_AHEAD` further keyframes before its depth is computed, and for as many again, whose depth must confirm its own,
before it is fused. What is done when depends on the keyframes given alone, never on how fast a thread was.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ground_station.reconstruction.admission import Admission
from ground_station.reconstruction.consistency import agreements
from ground_station.reconstruction.depth_map import DepthMap, make_estimator
from ground_station.reconstruction.depth_range import DepthRange
from ground_station.reconstruction.free_cells import free_cells
from ground_station.reconstruction.fusion import Volume
from ground_station.reconstruction.ledger import Ledger
from ground_station.reconstruction.pose_refiner import Pose, PoseRefiner
from ground_station.reconstruction.reconstructor import PATIENCE_S, Keyframe, Mesh, Outcome, State, Statistics
from ground_station.reconstruction.source_views import ViewIndex
from ground_station.reconstruction.surface_nets import extract_mesh
from ground_station.reconstruction.views import View, shrink, to_grey
from protocol.mission import Mission
from protocol.obstacle_grid import Cells, ObstacleGrid

LOOK_AHEAD: Final = 3
"""Later keyframes of the same drone that a keyframe waits for; 3 x 0.12 m is the widest useful baseline."""
FEATURE_WIDTH: Final = 320
"""px: largest width of images in which poses are refined."""
RESWEPT: Final = 4 * LOOK_AHEAD
"""Newest keyframes of each drone that get depth again after a restart: those that wait, and as many before them."""
VIEWS_KEPT: Final = 512
"""Newest keyframes that others may be compared with; 2048 made no better map, and 512 at 160 x 90 take 88 MB."""
TYPICAL_SHARE: Final = 0.6
"""Depth at which triangulation angles are rated, as a share of the empty box's: high things are the hard ones."""
BYTES_PER_PIXEL: Final = 12
"""Of a kept keyframe: grey, color, depth and score."""
AGREEMENTS_MIN: Final = 1
"""Other views that must confirm a depth."""
CONFIRMED_MIN: Final = 0.4
"""Least share of the depths found that others confirm: 99 % of the living room's keyframes have more, mostly 0.9, and
with their images swapped all had less. Below it the pose is wrong, and what was confirmed is chance."""
WEIGHT_MIN: Final = 0.3
"""Weight from which a voxel is part of the map; a good view from 1 m weighs 0.9, from 2 m 0.2."""


@dataclass(slots=True, eq=False)
class _Entry:
    """A keyframe on its way into the map."""

    drone: int
    sequence: int
    tick: int
    rank: int
    """Number of the drone's keyframes that were taken in before it."""
    ticket: int
    """Of the pose refiner."""
    view: View
    """Posed as it was known when it was taken in, and then when its depth was begun."""
    color: NDArray[np.uint8]
    span: DepthRange
    sources: tuple[_Entry, ...] = ()
    depth: Future[DepthMap] | None = None


class PlaneSweepReconstructor:
    """Implements `reconstructor.Reconstructor`."""

    def __init__(self, mission: Mission) -> None:
        settings = mission.reconstruction
        self._settings = settings
        sweep = mission.sweep_intrinsics()
        self._width, self._height = sweep.width, sweep.height
        self._patience = round(PATIENCE_S / mission.tick_s)
        self._estimator = make_estimator(self._width, self._height, settings)
        self._pool = ThreadPoolExecutor(settings.workers, thread_name_prefix="depth")
        self._volume = Volume(mission.target, settings.voxel_m, settings.truncation_m)
        self._refiner = make_refiner(mission)
        self._index = ViewIndex(VIEWS_KEPT)
        self._kept: list[_Entry | None] = [None] * VIEWS_KEPT
        self._unswept: list[_Entry] = []
        self._unfused: list[tuple[_Entry, Future[DepthMap]]] = []
        self._due: list[tuple[_Entry, Future[DepthMap]]] = []
        self._taken: Counter[int] = Counter()
        self._admission = Admission(mission)
        self._ledger = Ledger()

    def add(self, keyframes: Sequence[Keyframe]) -> tuple[Outcome, ...]:
        self._fuse_due()  # depth maps begun by the call before, computed while the caller was away
        outcomes = [self._admit(keyframe) for keyframe in keyframes]
        self._schedule()
        return (*outcomes, *self._ledger.take())

    def flush(self) -> tuple[Outcome, ...]:
        self._fuse_due()
        self._schedule(everything=True)
        self._fuse_due()
        return self._ledger.take()

    def mesh(self) -> Mesh:
        self._fuse_due()
        return extract_mesh(self._volume, WEIGHT_MIN)

    def free_cells(self, grid: ObstacleGrid) -> Cells:
        self._fuse_due()
        return free_cells(self._volume, WEIGHT_MIN, grid)

    def statistics(self) -> Statistics:
        kept = len(self._index) * self._width * self._height * BYTES_PER_PIXEL
        return self._ledger.statistics(
            self._volume.size_bytes + kept + (self._refiner.size_bytes if self._refiner else 0)
        )

    @property
    def lookback(self) -> int:
        return VIEWS_KEPT

    def state(self) -> State:
        self._fuse_due()
        waiting = [*self._unswept, *(entry for entry, _ in self._unfused)]
        return {
            **self._volume.state(),
            **(self._refiner.state() if self._refiner else {}),
            "waiting": np.array([(entry.drone, entry.tick) for entry in waiting], np.int64).reshape(-1, 2),
            "newest": self._admission.state(),
            **self._ledger.state(),
        }

    def restore(self, state: State, recent: Iterable[Keyframe]) -> None:
        self._volume.restore(state)
        if self._refiner:
            self._refiner.restore(state)
        for keyframe in recent:
            self._admit(keyframe, known=True)
        waiting = set(map(tuple, state["waiting"].tolist()))
        known = [entry for entry in self._unswept if (entry.drone, entry.tick) not in waiting]
        self._unswept = [entry for entry in self._unswept if (entry.drone, entry.tick) in waiting]
        for entry in known:  # without depth they could not confirm that of the waiting ones
            if self._taken[entry.drone] - entry.rank <= RESWEPT:
                self._sweep(entry)
                entry.sources = ()
        self._admission.restore(state["newest"])
        self._ledger.restore(state, waiting=len(self._unswept))

    def _admit(self, keyframe: Keyframe, known: bool = False) -> Outcome:
        """Keep what later steps need of a keyframe, unless it is of no use; ``known`` from before a restart."""
        self._ledger.received += 1
        color = shrink(keyframe.image, self._width, self._height)
        camera = keyframe.intrinsics.scaled_to(self._width, self._height)
        view = View(to_grey(color), keyframe.position, keyframe.rotation, camera)
        span = self._admission.examine(keyframe, view)
        if isinstance(span, str):
            return self._ledger.refuse(keyframe, span)
        ticket = self._refine(keyframe, span, known)
        if ticket is None:
            return self._ledger.refuse(keyframe, "pose")
        view = self._mended(view, ticket)
        rank = self._taken[keyframe.drone]
        entry = _Entry(keyframe.drone, keyframe.sequence, keyframe.tick, rank, ticket, view, color, span)
        self._taken[keyframe.drone] += 1
        self._kept[self._index.add(view)] = entry
        self._unswept.append(entry)
        return Outcome(keyframe.drone, keyframe.sequence, "waiting")

    def _schedule(self, everything: bool = False) -> None:
        """Begin the depth maps that are due, and note what can be fused once they are there."""
        now = max(self._admission.newest.values(), default=0)

        def is_due(entry: _Entry, stages: int) -> bool:
            followed = self._taken[entry.drone] - 1 - entry.rank >= stages * LOOK_AHEAD
            return everything or followed or now - entry.tick >= stages * self._patience

        for entry in [entry for entry in self._unswept if is_due(entry, 1)]:
            self._unswept.remove(entry)
            depth = self._sweep(entry)
            if depth is None:
                self._ledger.note(self._ledger.refuse(entry, "no_overlap"))
            else:
                self._unfused.append((entry, depth))
        self._due += [swept for swept in self._unfused if is_due(swept[0], 2)]
        self._unfused = [swept for swept in self._unfused if not is_due(swept[0], 2)]

    def _sweep(self, entry: _Entry) -> Future[DepthMap] | None:
        """Begin a depth map; None if there is nothing to compare with."""
        entry.sources = self._sources(entry.view, entry.span)
        if entry.sources:
            entry.view = self._mended(entry.view, entry.ticket)
            views = [self._mended(source.view, source.ticket) for source in entry.sources]
            entry.depth = self._pool.submit(self._estimator.estimate, entry.view, views, entry.span)
        return entry.depth

    def _mended(self, view: View, ticket: int) -> View:
        """With the pose that is known by now."""
        pose = self._refiner.pose(ticket) if self._refiner else None
        return replace(view, position=pose.position, rotation=pose.rotation) if pose else view

    def _refine(self, keyframe: Keyframe, span: DepthRange, known: bool) -> int | None:
        """The keyframe's ticket of the refiner, 0 if poses are not refined; None if its pose is wrong."""
        if self._refiner is None:
            return 0
        height, width = self._refiner.size
        same = keyframe.image.shape[:2] == self._refiner.size
        grey = to_grey(keyframe.image if same else shrink(keyframe.image, width, height))
        if known:
            return self._refiner.recall(keyframe.drone, keyframe.tick, grey)
        camera = keyframe.intrinsics.scaled_to(width, height)
        depths = max(span.nearest, self._settings.nearest_m), min(span.farthest, self._settings.farthest_m)
        pose = Pose(keyframe.position, keyframe.rotation)
        return self._refiner.add(keyframe.drone, keyframe.tick, grey, camera, pose, depths)

    def _sources(self, view: View, span: DepthRange) -> tuple[_Entry, ...]:
        depth = min(TYPICAL_SHARE * span.typical, self._settings.farthest_m)
        slots = self._index.sources(view, depth, self._settings.sources)
        return tuple(entry for slot in slots if (entry := self._kept[slot]) is not None)

    def _fuse_due(self) -> None:
        """Average the depth that other views confirm into the volume, in the order in which keyframes came due."""
        for entry, depth_map in self._due:
            found = depth_map.result()
            others = [(source.view, source.depth.result().depth) for source in entry.sources if source.depth]
            entry.sources = ()  # else every keyframe would keep all before it alive
            confirmed = agreements(entry.view, found.depth, others) >= AGREEMENTS_MIN
            if not confirmed.any() or np.count_nonzero(confirmed) < CONFIRMED_MIN * np.count_nonzero(found.depth):
                self._ledger.note(self._ledger.refuse(entry, "no_depth"))
                continue
            depth = np.where(confirmed, found.depth, np.float32(0))
            weight = found.score / np.maximum(found.depth, np.float32(self._settings.nearest_m)) ** 2
            self._volume.integrate(entry.view, depth, weight, entry.color)
            self._ledger.note(self._ledger.fuse(entry))
        self._due.clear()


def make_refiner(mission: Mission) -> PoseRefiner | None:
    settings, camera = mission.reconstruction, mission.camera
    if not settings.refine_poses:
        return None
    width = min(FEATURE_WIDTH, camera.width_px)
    height = round(width * camera.height_px / camera.width_px)
    return PoseRefiner(VIEWS_KEPT, width, height, settings.pose_sigma_m, settings.pose_sigma_rad)
