"""Mends the poses of keyframes: what they show must lie in one place, and each camera near where it was measured to be.

Small patches of earlier keyframes, of all drones, are found again in the new one. With them and with the measured
poses, those of the drone's newest keyframes are adjusted together. Measurement errors that differ from frame to frame
so cancel out; an error that all share stays, for nothing in the images tells of it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ground_station.reconstruction.bundle import (
    DOUBTED_PX,
    SIGHTINGS_MAX,
    Landmarks,
    Prior,
    adjust,
    sighting_errors,
)
from ground_station.reconstruction.corners import find_corners
from ground_station.reconstruction.patch_search import RADIUS
from ground_station.reconstruction.track_search import COARSE, choose, find
from protocol.errors import ReconstructionError
from protocol.geometry import Floats, Intrinsics, rotation_vector

CELLS_ACROSS: Final = 16
"""Squares across the image of which each has at most one landmark: 144 in 320 x 180."""
WINDOW: Final = 16
"""Newest keyframes of a drone whose poses are adjusted."""
SIGMAS: Final = 3.0
"""Measured poses are believed within so many standard deviations where landmarks are looked for."""
SIGMAS_MAX: Final = 5.0
"""A correction beyond this is a fault, not noise."""
TRIES: Final = 4
"""Keyframes in which a corner is looked for before it is given up."""
CLOSE_PX: Final = 2.5
"""Around where a landmark must be once the pose is known."""
WRONG_PX: Final = 3.0
"""A sighting off by more is dropped."""
JUDGES_MIN: Final = 20
"""Landmarks that should show before their absence speaks against the pose ..."""
SHOWN_MIN: Final = 0.2
"""... and the least share of them that must."""
SIGHTED_MIN: Final = 4
"""Landmarks from which a pose is known: each gives two of its six unknowns, and the measurement the rest."""
ANNEALED_PX: Final = (12.0, 6.0, 3.0, DOUBTED_PX)
"""How far sightings are trusted, step by step, while the pose is still that measured."""
SETTLING: Final = 3
"""Steps of the adjustment of a window."""
NOBODY: Final = -1
"""Drone and tick of a slot that is not used yet."""
REVIEWED: Final = 64
"""Newest keyframes whose corners, not found again yet, are looked for."""


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    position: Floats
    """(3,) m."""
    rotation: Floats
    """(3, 3), camera to world."""


class PoseRefiner:
    """Keeps the newest ``capacity`` keyframes, by slots that are used in turn."""

    def __init__(self, capacity: int, width: int, height: int, sigma_m: float, sigma_rad: float) -> None:
        """``width`` and ``height`` of the images; standard deviations of each axis of the measured poses."""
        self._cell = -(-width // CELLS_ACROSS)
        cells = -(-height // self._cell), -(-width // self._cell)
        most = cells[0] * cells[1]
        self.size, self._cells = (height, width), cells
        self._key = np.full((capacity, 2), NOBODY, np.int64)
        self._fine = np.zeros((capacity, height, width), np.uint8)
        self._coarse = np.zeros((capacity, height // COARSE, width // COARSE), np.uint8)
        self._pictured = np.zeros(capacity, np.bool_)  # what others showed cannot be found again
        self._camera = np.ones((capacity, 4))
        self._position, self._rotation = np.zeros((capacity, 3)), np.zeros((capacity, 3, 3))
        self._prior = Prior(np.zeros((capacity, 3)), np.zeros((capacity, 3, 3)), sigma_m, sigma_rad)
        self._corners = np.zeros((capacity, most, 2))
        self._corner_count = np.zeros(capacity, np.int64)
        self._inverse_depth = np.zeros((capacity, most))
        self._tries = np.zeros((capacity, most), np.int64)
        self._sightings = np.zeros((capacity, most), np.int64)
        self._view = np.zeros((capacity, most, SIGHTINGS_MAX), np.int16)
        self._place = np.zeros((capacity, most, SIGHTINGS_MAX, 2))
        self._seen: list[NDArray[np.int64]] = [np.empty((0, 2), np.int64)] * capacity
        self._windows: dict[int, deque[int]] = {}
        self._added = 0

    def add(
        self,
        drone: int,
        tick: int,
        grey: NDArray[np.uint8],
        camera: Intrinsics,
        measured: Pose,
        depths: tuple[float, float],
    ) -> int | None:
        """A ticket for a new keyframe; None if its pose is wrong, and then it is not kept.

        ``camera``: the intrinsics of ``grey`` (H, W). ``depths``, nearest and farthest, m: where something may be seen.
        """
        capacity = len(self._position)
        here = self._added % capacity
        self._store(here, grey, camera, measured)
        earlier = np.array([(self._added - 1 - n) % capacity for n in range(min(self._added, capacity - 1))], np.int64)
        earlier = earlier[self._pictured[earlier]]
        sighted, judged = self._align(here, earlier)
        aligned = len(sighted) >= max(SIGHTED_MIN, SHOWN_MIN * judged)
        if (judged >= JUDGES_MIN and not aligned) or self._correction(here) > SIGMAS_MAX:
            self._unnote(sighted)
            return None
        window = self._windows.setdefault(drone, deque(maxlen=WINDOW))
        fresh = self._widen(here, earlier[:REVIEWED], sighted, depths, aligned)
        self._seen[here] = np.concatenate([sighted, fresh])
        free = np.array([*window, here][-WINDOW:], np.int64)
        if self._added > 0:
            self._settle(free, (DOUBTED_PX,) * SETTLING if aligned else ANNEALED_PX)
        window.append(here)
        self._key[here] = drone, tick
        self._plant(here, depths)
        self._added += 1
        return self._added - 1

    def pose(self, ticket: int) -> Pose | None:
        """As known by now; None if so many came after it that its slot is used again, or was for one refused."""
        slot = ticket % len(self._key)
        if ticket <= self._added - len(self._key):
            return None
        return Pose(self._position[slot].copy(), self._rotation[slot].copy())

    def state(self) -> dict[str, NDArray[Any]]:
        """For a checkpoint; the images are not in it."""
        return {
            "pose_added": np.array(self._added),
            "pose_sighting_view": self._view[self._valid()],
            "pose_sighting_place": self._place[self._valid()],
            **{f"pose_{name}": array.copy() for name, array in self._tables().items()},
        }

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Know again what another knew; its images are still to be given, by `recall`.

        Raises `ReconstructionError` if that was one of another size.
        """
        for name, array in self._tables().items():
            if state[f"pose_{name}"].shape != array.shape:
                raise ReconstructionError("the state of refined poses does not fit")
            array[:] = state[f"pose_{name}"]
        self._added = int(state["pose_added"])
        valid = self._valid()
        self._view[valid], self._place[valid] = state["pose_sighting_view"], state["pose_sighting_place"]
        view, corner, sighting = np.nonzero(valid)
        seen_by = self._view[view, corner, sighting]
        capacity = len(self._key)
        self._windows.clear()
        for slot in (np.arange(self._added - min(self._added, capacity), self._added) % capacity).tolist():
            self._windows.setdefault(int(self._key[slot, 0]), deque(maxlen=WINDOW)).append(slot)
            self._seen[slot] = np.column_stack([view, corner])[seen_by == slot]
        self._pictured[:] = False

    def recall(self, drone: int, tick: int, grey: NDArray[np.uint8]) -> int | None:
        """After `restore`: the ticket of a keyframe that is known; None if it is not."""
        slots = np.flatnonzero((self._key == (drone, tick)).all(axis=1))
        if not len(slots):
            return None
        slot = int(slots[0])
        self._keep_image(slot, grey)
        newest = self._added - 1
        return newest - (newest - slot) % len(self._key)

    @property
    def size_bytes(self) -> int:
        tables: list[NDArray[Any]] = [self._fine, self._coarse, self._view, self._place, *self._tables().values()]
        return sum(table.nbytes for table in tables)

    def _valid(self) -> NDArray[np.bool_]:
        """(V, P, SIGHTINGS_MAX): which sightings there are."""
        return np.arange(SIGHTINGS_MAX) < self._sightings[..., None]

    def _tables(self) -> dict[str, NDArray[Any]]:
        return {
            "key": self._key,
            "camera": self._camera,
            "position": self._position,
            "rotation": self._rotation,
            "measured_position": self._prior.position,
            "measured_rotation": self._prior.rotation,
            "corners": self._corners,
            "corner_count": self._corner_count,
            "inverse_depth": self._inverse_depth,
            "tries": self._tries,
            "sightings": self._sightings,
        }

    def _keep_image(self, slot: int, grey: NDArray[np.uint8]) -> None:
        height, width = self.size
        self._fine[slot] = grey
        self._pictured[slot] = True
        rows, columns = height // COARSE, width // COARSE
        blocks = grey[: rows * COARSE, : columns * COARSE].reshape(rows, COARSE, columns, COARSE)
        self._coarse[slot] = (blocks.sum(axis=(1, 3), dtype=np.uint16) + COARSE) // COARSE**2

    def _store(self, here: int, grey: NDArray[np.uint8], camera: Intrinsics, measured: Pose) -> None:
        self._keep_image(here, grey)
        self._camera[here] = camera.fx, camera.fy, camera.cx - 0.5, camera.cy - 0.5
        for poses in ((self._position, self._rotation), (self._prior.position, self._prior.rotation)):
            poses[0][here], poses[1][here] = measured.position, measured.rotation
        self._key[here] = NOBODY
        self._corner_count[here] = 0
        self._sightings[here] = 0
        self._seen[here] = np.empty((0, 2), np.int64)
        for window in self._windows.values():
            if here in window:  # a drone that has hovered since
                window.remove(here)

    def _align(self, here: int, earlier: NDArray[np.int64]) -> tuple[NDArray[np.int64], int]:
        """Bring the pose to where known landmarks show; those that then do, (N, 2), and how many should."""
        taken = np.zeros(self._cells, np.bool_)
        worth = np.where(self._sightings < SIGHTINGS_MAX, self._sightings, 0)
        chosen = self._choose(earlier, worth, here, taken)
        judged = int(np.count_nonzero(self._sightings[chosen[:, 0], chosen[:, 1]] >= 2))
        if not len(chosen):
            return chosen, judged
        depth = 1 / self._inverse_depth[chosen[:, 0], chosen[:, 1]]
        found = self._find(chosen, here, self._reach(here, float(np.median(depth))))
        sighted = self._note(here, chosen, found)
        kept = self._inverse_depth[sighted[:, 0], sighted[:, 1]]
        self._adjust(np.array([here]), sighted, ANNEALED_PX)
        self._inverse_depth[sighted[:, 0], sighted[:, 1]] = kept
        self._unnote(sighted)
        found = self._find(chosen, here, CLOSE_PX)
        return self._note(here, chosen, found), judged

    def _widen(
        self,
        here: int,
        earlier: NDArray[np.int64],
        sighted: NDArray[np.int64],
        depths: tuple[float, float],
        aligned: bool,
    ) -> NDArray[np.int64]:
        """Look for corners whose depth is not known yet; (N, 2) of those found."""
        worth = np.where(self._sightings == 0, TRIES - self._tries, 0)
        chosen = self._choose(earlier, worth, here, self._taken(here, sighted))
        if not len(chosen):
            return chosen
        self._tries[chosen[:, 0], chosen[:, 1]] += 1
        depth = 1 / self._inverse_depth[chosen[:, 0], chosen[:, 1]]
        reach = CLOSE_PX if aligned else self._reach(here, float(np.median(depth)))
        found = self._find(chosen, here, reach, depths)
        shown = found[:, 2] > 0
        self._inverse_depth[chosen[shown, 0], chosen[shown, 1]] = found[shown, 3]
        return self._note(here, chosen, found)

    def _settle(self, free: NDArray[np.int64], trusts: tuple[float, ...]) -> None:
        """Adjust the poses of ``free`` and all landmarks they see, and drop sightings that do not fit."""
        own = [
            np.column_stack([np.full(count, view), np.arange(count)])
            for view in free
            if (count := self._corner_count[view])
        ]
        chosen = np.concatenate([*own, *(self._seen[view] for view in free)])
        chosen = np.unique(chosen, axis=0)
        chosen = chosen[self._sightings[chosen[:, 0], chosen[:, 1]] > 0]
        if len(chosen):
            landmarks = self._adjust(free, chosen, trusts)
            errors = sighting_errors(self._position, self._rotation, self._camera[:, 0].copy(), landmarks)
            for number in np.flatnonzero((errors > WRONG_PX).any(axis=1)):
                view, corner = chosen[number]
                good = np.flatnonzero(errors[number, : landmarks.count[number]] <= WRONG_PX)
                self._view[view, corner, : len(good)] = self._view[view, corner, good]
                self._place[view, corner, : len(good)] = self._place[view, corner, good]
                self._sightings[view, corner] = len(good)

    def _plant(self, here: int, depths: tuple[float, float]) -> None:
        """New corners where no landmark shows."""
        taken = self._taken(here, self._seen[here])
        corners = find_corners(self._fine[here].astype(np.float32), self._cell, RADIUS + 2)
        column, row = (corners // self._cell).astype(int).T
        corners = corners[~taken[row, column]]
        self._corner_count[here] = len(corners)
        self._corners[here, : len(corners)] = corners
        self._inverse_depth[here] = (1 / depths[0] + 1 / depths[1]) / 2
        self._tries[here] = 0

    def _correction(self, here: int) -> float:
        """The largest, in standard deviations."""
        moved = np.abs(self._position[here] - self._prior.position[here]).max() / self._prior.sigma_m
        turn = rotation_vector(self._rotation[here] @ self._prior.rotation[here].T)
        return float(max(moved, np.abs(turn).max() / self._prior.sigma_rad))

    def _reach(self, here: int, depth: float) -> float:
        """Pixels between where measured poses put a landmark and where it shows."""
        focal = self._camera[here, 0]
        error = np.hypot(self._prior.sigma_rad, self._prior.sigma_m / depth)
        return float(SIGMAS * np.sqrt(2) * focal * error)

    def _taken(self, here: int, sighted: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Cells (rows, columns) in which ``sighted`` show, by their newest sighting."""
        taken = np.zeros(self._cells, np.bool_)
        last = self._sightings[sighted[:, 0], sighted[:, 1]] - 1
        kept = (last >= 0) & (self._view[sighted[:, 0], sighted[:, 1], last] == here)
        sighted, last = sighted[kept], last[kept]
        place = self._place[sighted[:, 0], sighted[:, 1], last]
        camera = self._camera[here]
        column, row = ((place * camera[:2] + camera[2:]) // self._cell).astype(int).T
        taken[row, column] = True
        return taken

    def _choose(
        self, views: NDArray[np.int64], worth: NDArray[np.int64], here: int, taken: NDArray[np.bool_]
    ) -> NDArray[np.int64]:
        return choose(
            views, self._position, self._rotation, self._camera, self._corners, self._corner_count,
            self._inverse_depth, worth, here, self.size, self._cell, taken,
        )  # fmt: skip

    def _find(
        self, chosen: NDArray[np.int64], here: int, reach: float, depths: tuple[float, float] = (0.0, 0.0)
    ) -> Floats:
        return find(
            chosen, self._fine, self._coarse, self._position, self._rotation, self._camera, self._corners,
            self._inverse_depth, here, reach, *depths,
        )  # fmt: skip

    def _note(self, here: int, chosen: NDArray[np.int64], found: Floats) -> NDArray[np.int64]:
        """Add sightings; those of ``chosen`` that have one, (N, 2)."""
        shown = found[:, 2] > 0
        view, corner = chosen[shown].T
        last = self._sightings[view, corner]
        self._view[view, corner, last] = here
        self._place[view, corner, last] = (found[shown, :2] - self._camera[here, 2:]) / self._camera[here, :2]
        self._sightings[view, corner] += 1
        return chosen[shown]

    def _unnote(self, sighted: NDArray[np.int64]) -> None:
        self._sightings[sighted[:, 0], sighted[:, 1]] -= 1

    def _adjust(self, free: NDArray[np.int64], chosen: NDArray[np.int64], trusts: tuple[float, ...]) -> Landmarks:
        view, corner = chosen.T
        camera = self._camera[view]
        ray = np.ones((len(chosen), 3))
        ray[:, :2] = (self._corners[view, corner] - camera[:, 2:]) / camera[:, :2]
        landmarks = Landmarks(
            view,
            ray,
            self._inverse_depth[view, corner],
            self._sightings[view, corner],
            self._view[view, corner],
            self._place[view, corner],
        )
        focal = self._camera[:, 0].copy()
        for trust in trusts:
            adjust(self._position, self._rotation, focal, free, self._prior, landmarks, trust)
        self._inverse_depth[view, corner] = landmarks.inverse_depth
        return landmarks
