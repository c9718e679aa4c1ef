"""Meshes as the reconstructor makes them, of boxes on a floor and without images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ground_station.reconstruction.fusion import Volume
from ground_station.reconstruction.reconstructor import Mesh
from ground_station.reconstruction.surface_nets import extract_mesh
from protocol.geometry import Floats
from protocol.mission import Box

FLOOR_M = 0.003
"""Height of the floor: near B's lower face, as that of a room."""
TRUNCATION_M = 0.05
WAVINESS_M = 0.004
"""So that no surface is flat and no vertex lies exactly where another does."""


@dataclass(frozen=True, slots=True)
class Block:
    """A box-shaped thing."""

    centre: tuple[float, float, float]
    half: tuple[float, float, float]


def of_points(vertices: NDArray[np.float32]) -> Mesh:
    """A mesh without faces."""
    return Mesh(vertices, np.empty((0, 3), np.int32), np.zeros(vertices.shape, np.uint8))


def shuffled(mesh: Mesh, seed: int = 0) -> Mesh:
    """The same surface, its vertices and faces in another order."""
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(mesh.vertices))
    places = np.empty(len(order), np.int32)
    places[order] = np.arange(len(order), dtype=np.int32)
    return Mesh(mesh.vertices[order], places[rng.permutation(mesh.faces)], mesh.colors[order])


def together(first: Mesh, second: Mesh) -> Mesh:
    return Mesh(
        np.vstack([first.vertices, second.vertices]),
        np.vstack([first.faces, second.faces + np.int32(len(first.vertices))]),
        np.vstack([first.colors, second.colors]),
    )


def furnished(
    box: Box,
    blocks: Sequence[Block] = (),
    *,
    voxel_m: float = 0.025,
    seen_to_x: float = np.inf,
    ripple_m: float = 0.0,
    ripple_from_x: float = -np.inf,
) -> Mesh:
    """The floor of ``box`` with ``blocks`` on it, mapped where x is below ``seen_to_x``.

    From ``ripple_from_x`` on, ``ripple_m`` moves surfaces as further views of them would.
    """
    volume = Volume(box, voxel_m, TRUNCATION_M)
    x, y, z = (
        np.expand_dims(low + voxel_m * np.arange(count), tuple({0, 1, 2} - {axis}))
        for axis, (low, count) in enumerate(zip(volume.origin, volume.distance.shape, strict=True))
    )
    distance = z - FLOOR_M + np.zeros(volume.distance.shape)
    for block in blocks:
        distance = np.minimum(distance, _distance(block, (x, y, z)))
    distance += WAVINESS_M * np.sin(7 * x + y) * np.sin(9 * y + 1) * np.cos(8 * z + x)
    distance += ripple_m * np.sin(11 * x + 2) * np.sin(13 * y) * (x >= ripple_from_x)
    volume.distance[:] = np.clip(distance, -TRUNCATION_M, TRUNCATION_M)
    volume.weight[:] = (x < seen_to_x) & (distance > -TRUNCATION_M)
    return extract_mesh(volume, weight_min=0.5)


def _distance(block: Block, place: tuple[Floats, Floats, Floats]) -> Floats:
    """Of each place to the block's surface, negative inside."""
    over = [np.abs(axis - centre) - half for axis, centre, half in zip(place, block.centre, block.half, strict=True)]
    outside = np.sqrt(sum(np.maximum(part, 0) ** 2 for part in over))
    return outside + np.minimum(np.maximum(np.maximum(over[0], over[1]), over[2]), 0)
