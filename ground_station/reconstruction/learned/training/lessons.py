"""From a training room's file to lessons: the photographs of one fragment, and what the network should say of it."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ground_station.reconstruction.fusion import Volume
from ground_station.reconstruction.learned.fragment import (
    COARSE,
    FINE_M,
    REACH_M,
    VIEWS_MIN,
    choose_views,
    middle_of,
    place_window,
    projection,
)
from ground_station.reconstruction.learned.training.settings import TrainingSettings
from ground_station.reconstruction.views import View
from protocol.errors import TrainingError
from protocol.geometry import Floats, Intrinsics, camera_rotation
from protocol.mission import Box, Target

CANDIDATES: Final = 96
"""Newest photographs that a fragment is chosen from."""
TRIED: Final = 3
"""Lessons from which the one with the most surface is taken: much of a room is bare floor, which is soon learnt."""
JITTER_M: Final = 0.3
"""Standard deviation of the window's place, so that every part of a fragment is learnt from."""
STEPS: Final = 127
"""Distances are kept in so many steps on either side of the surface, 1 mm each."""
GAMMA: Final = (0.7, 1.4)
EXPOSURE: Final = (0.6, 1.4)
"""Ranges of what all photographs of a lesson are changed by ..."""
FLICKER: Final = 0.06
"""... and standard deviation of what each is by itself."""


NO_IMAGE: Final = np.empty((0, 0), np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class Room:
    images: NDArray[np.uint8]
    """(N, H, W, 3), in the order in which they were taken."""
    views: list[View]
    """Without images of their own."""
    sortie: NDArray[np.int64]
    """(N,): photographs of different sorties show different textures, and are never of one lesson."""
    box: Box
    origin: Floats
    """(3,) m, the first voxel."""
    distance: NDArray[np.int8]
    """(X, Y, Z) signed distance in `STEPS` of `fragment.REACH_M`; -STEPS too where no photograph ever saw."""
    occupied: NDArray[np.bool_]
    """(X, Y, Z), within reach of a surface that was seen."""


@dataclass(frozen=True, slots=True, eq=False)
class Lesson:
    images: NDArray[np.float32]
    """(V, 3, H, W) in [0, 1]."""
    projections: NDArray[np.float32]
    """(V, 3, 4) as of `fragment.projection`, but from the window's own frame: its first fine voxel is at the origin."""
    distance: NDArray[np.float32]
    """(X, Y, Z) of fine voxels, in [-1, 1]."""
    occupied: NDArray[np.bool_]
    """(X, Y, Z)"""


@dataclass(frozen=True, slots=True, eq=False)
class _Scope:
    """What a lesson would be of."""

    room: Room
    places: NDArray[np.int64]
    """Of its photographs."""
    first: tuple[int, int, int]
    """Voxel of the room at the window's lower corner."""
    part: tuple[slice, ...]
    """The window."""

    @property
    def surface(self) -> int:
        """Voxels near surfaces."""
        return int(np.count_nonzero(self.room.occupied[self.part]))


def load_room(path: Path) -> Room:
    """Raises `TrainingError`, naming the file, if it is no room or one of another lattice."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            images, depth, poses = file["images"], file["depth"], file["poses"]
            focal, sortie, distance = file["focal_px"], file["sortie"], file["distance"]
            origin, voxel = file["origin"], float(file["voxel"])
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise TrainingError(f"{path}: {error}") from error
    box = Target()
    volume = Volume(box, FINE_M, REACH_M)
    if voxel != FINE_M or distance.shape != volume.distance.shape or not np.allclose(origin, volume.origin):
        raise TrainingError(f"{path}: its lattice, {distance.shape} of {voxel} m, is not the network's")
    height, width = images.shape[1:3]
    views = [
        View(
            NO_IMAGE,
            pose[:3],
            camera_rotation(pose[3], pose[4]),
            Intrinsics(width, height, f, f, width / 2, height / 2),
        )
        for pose, f in zip(poses, focal.tolist(), strict=True)
    ]
    for view, seen in zip(views, depth, strict=True):
        _observe(volume, view, seen)
    observed = volume.weight > 0
    signed = np.where(volume.distance >= 0, distance, -distance).astype(np.float32) / np.float32(REACH_M)
    steps = np.where(observed, np.rint(STEPS * np.clip(signed, -1, 1)), -STEPS).astype(np.int8)
    return Room(
        images,
        views,
        sortie,
        box,
        volume.origin,
        steps,
        observed & (np.abs(steps) < STEPS),
    )


def _observe(volume: Volume, view: View, depth: NDArray[np.float16]) -> None:
    height, width = depth.shape
    view = replace(view, intrinsics=view.intrinsics.scaled_to(width, height))
    metres = np.where(np.isfinite(depth), depth, 0).astype(np.float32)
    volume.integrate(view, metres, np.ones_like(metres), np.zeros((height, width, 3), np.uint8))


def draw_lesson(rooms: list[Room], settings: TrainingSettings, draw: int, *, varied: bool = True) -> Lesson:
    """The lesson of a draw; ``varied``: with light, colours, poses and axes changed, and rather of furniture."""
    rng = np.random.default_rng([settings.seed, draw])
    tried = [_draw_scope(rooms, settings, rng, varied) for _ in range(TRIED if varied else 1)]
    return _lesson(max(tried, key=lambda scope: scope.surface), settings, rng, varied)


def _draw_scope(rooms: list[Room], settings: TrainingSettings, rng: np.random.Generator, varied: bool) -> _Scope:
    while True:
        room = rooms[int(rng.integers(len(rooms)))]
        newest = int(rng.integers(len(room.views)))
        places = np.arange(newest, max(newest - CANDIDATES, -1), -1)
        places = places[room.sortie[places] == room.sortie[newest]]
        if rng.random() < 0.5:  # as when other drones' keyframes lie between
            places[1:] = rng.permutation(places[1:])
        chosen = choose_views([room.views[place] for place in places], room.box)
        if len(chosen) >= VIEWS_MIN:
            break
    centre = middle_of([room.views[place] for place in places[chosen]], room.box)
    centre += rng.normal(0, JITTER_M, 3) if varied else 0
    window = place_window(centre, room.origin, room.distance.shape, settings.window)
    size = COARSE * np.array(settings.window)
    part = tuple(slice(low, low + count) for low, count in zip(window.first, size, strict=True))
    return _Scope(room, places[chosen], window.first, part)


def _lesson(scope: _Scope, settings: TrainingSettings, rng: np.random.Generator, varied: bool) -> Lesson:
    room, size = scope.room, COARSE * np.array(settings.window)
    views = [room.views[place] for place in scope.places]
    distance, occupied = _padded(room.distance[scope.part], size, -STEPS), _padded(room.occupied[scope.part], size, 0)
    images = room.images[scope.places].astype(np.float32) / np.float32(255)
    to_world = np.eye(4)
    to_world[:3, 3] = room.origin + FINE_M * np.array(scope.first)
    if varied:
        views = [_shaken(view, settings, rng) for view in views]
        images = _relit(images, rng)
        turn, distance, occupied = _turned(distance, occupied.astype(np.bool_), rng)
        to_world = to_world @ turn
    projections = np.stack([projection(view) @ to_world for view in views])
    return Lesson(
        np.ascontiguousarray(images.transpose(0, 3, 1, 2)),
        projections.astype(np.float32),
        np.ascontiguousarray(distance, np.float32) / np.float32(STEPS),
        np.ascontiguousarray(occupied, np.bool_),
    )


def _padded(part: NDArray[np.generic], size: NDArray[np.int64], fill: int) -> NDArray[np.generic]:
    """``part`` grown to ``size`` at its upper ends, where the window reaches beyond the room."""
    return np.pad(
        part, [(0, int(want - have)) for want, have in zip(size, part.shape, strict=True)], constant_values=fill
    )


def _shaken(view: View, settings: TrainingSettings, rng: np.random.Generator) -> View:
    """With an error of the pose: of some views small, of others as large as the settings allow."""
    share = rng.random()
    axis = rng.normal(0, share * settings.pose_noise_rad, 3)
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    rotation = view.rotation @ (np.eye(3) + skew + skew @ skew / 2)  # to the third order a rotation
    position = view.position + rng.normal(0, share * settings.pose_noise_m, 3)
    return replace(view, position=position, rotation=rotation)


def _relit(images: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Other colours, exposure and gamma, the same for all views but for a flicker."""
    channels = rng.permutation(3)
    gain = rng.uniform(*EXPOSURE) * (1 + rng.normal(0, FLICKER, (len(images), 1, 1, 1)))
    relit = (images[..., channels] * gain.astype(np.float32)).clip(0, 1) ** np.float32(rng.uniform(*GAMMA))
    return np.asarray(relit, np.float32)


def _turned(
    distance: NDArray[np.generic], occupied: NDArray[np.bool_], rng: np.random.Generator
) -> tuple[Floats, NDArray[np.generic], NDArray[np.bool_]]:
    """Window and answers turned by quarters about z and mirrored; with it the old place of each new one, (4, 4)."""
    to_old = np.eye(4)
    for axis in (0, 1):
        if rng.random() < 0.5:
            distance, occupied = np.flip(distance, axis), np.flip(occupied, axis)
            mirror = np.eye(4)
            mirror[axis, axis], mirror[axis, 3] = -1.0, FINE_M * (distance.shape[axis] - 1)
            to_old = to_old @ mirror
    if rng.random() < 0.5:
        distance, occupied = np.swapaxes(distance, 0, 1), np.swapaxes(occupied, 0, 1)
        to_old = to_old @ np.eye(4)[[1, 0, 2, 3]]
    return to_old, distance, occupied


def to_coarse(
    distance: NDArray[np.float32], occupied: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """What the coarse level should say: the mean distance, and whether any of its voxels is near a surface."""
    x, y, z = (size // COARSE for size in distance.shape)
    shape = (x, COARSE, y, COARSE, z, COARSE)
    mean: NDArray[np.float32] = distance.reshape(shape).mean(axis=(1, 3, 5))
    near = np.asarray(occupied.reshape(shape).any(axis=(1, 3, 5)))
    return mean, near
