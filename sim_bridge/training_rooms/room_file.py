"""One training room as a file: what cameras photographed, from where, and how far each place is from any surface.

Which side of a surface a place lies on is not written: who learns decides from the depth what was observed at all.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.geometry import Floats, Intrinsics
from protocol.mission import Target
from sim_bridge.camera import Camera, add_noise
from sim_bridge.scenes.lighting import bake, ray_caster
from sim_bridge.scenes.random_room import random_room
from sim_bridge.scenes.scene import pack_scene, replace_file
from sim_bridge.scenes.texture_set import with_contrast
from sim_bridge.training_rooms.sorties import sortie

WIDTH, HEIGHT = 256, 144
"""Pixels of a photograph: what the network is shown."""
DEPTH_WIDTH, DEPTH_HEIGHT = 128, 72
"""Pixels of its depth: 2 cm apart at 2 m, half a voxel."""
FIELD_OF_VIEW_RAD = (math.radians(65), math.radians(85))
"""Range of the horizontal field of view; the paper's camera has 73.7 degrees."""
CONTRAST = (0.08, 1.0)
"""Range of the textures' contrast: from painted in plain colours to as drawn."""
NOISE = (1.0, 4.0)
"""Range of the camera's noise, in grey levels of 255."""
SORTIES = 2
"""Of a room, each with textures of another contrast, another camera and another path."""
PHOTOGRAPHS = 110
"""Of a sortie."""
COARSE = 4
"""The distance is computed on every fourth place of the lattice first, then only where that is near a surface."""
CHUNK = 1 << 18
"""Places whose distance is asked for at a time."""


def write_room(path: Path, seed: int, voxel_m: float, reach_m: float) -> None:
    """Furnish the room of ``seed`` and write what is learnt from.

    The file holds ``images`` uint8 (N, H, W, 3), ``depth`` float16 (N, h, w) along the optical axis, +inf for nothing,
    ``poses`` (N, 5) as in `protocol.geometry`, ``focal_px`` (N,) of the images, ``sortie`` (N,), the lattice's
    ``origin`` (3,) and ``voxel``, and ``distance`` float16 (X, Y, Z), metres to the nearest surface, cut at
    ``reach_m``. The lattice is the default target box grown by ``reach_m``, a multiple of ``voxel_m``.
    """
    rng = np.random.default_rng([seed, 1])  # the room itself is drawn by the seed alone
    surfaces, textures = random_room(seed)
    caster = ray_caster(surfaces.triangles)
    lit = bake(surfaces)
    parts: list[dict[str, NDArray[Any]]] = []
    for number in range(SORTIES):
        # Even in the logarithm: what is hard is the lower end.
        contrast = math.exp(rng.uniform(*np.log(CONTRAST)))
        scene = pack_scene(lit, [with_contrast(image, contrast) for image in textures])
        view_rad = rng.uniform(*FIELD_OF_VIEW_RAD)
        camera = Camera(scene, Intrinsics.from_field_of_view(WIDTH, HEIGHT, view_rad))
        depth_camera = Camera(scene, Intrinsics.from_field_of_view(DEPTH_WIDTH, DEPTH_HEIGHT, view_rad))
        poses = sortie(rng, PHOTOGRAPHS, lambda places: _distances(caster, places.astype(np.float32)))
        noise = rng.uniform(*NOISE)
        parts.append(
            {
                "images": np.stack([add_noise(camera.render(pose.tolist()), noise, rng) for pose in poses]),
                "depth": np.stack([depth_camera.render_depth(pose.tolist()) for pose in poses]).astype(np.float16),
                "poses": poses,
                "focal_px": np.full(len(poses), WIDTH / 2 / math.tan(view_rad / 2)),
                "sortie": np.full(len(poses), number),
            }
        )
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    origin, distance = _distance_lattice(caster, voxel_m, reach_m)
    with replace_file(path) as file:
        content: dict[str, Any] = {**joined, "origin": origin, "voxel": np.array(voxel_m)}
        np.savez(file, **content, distance=distance.astype(np.float16))


def _distances(caster: Any, places: NDArray[np.float32]) -> Floats:
    """(n,) metres from places (n, 3) to the nearest triangle."""
    import open3d as o3d

    tensor: Any = o3d.core.Tensor  # its stubs demand a dtype and a device that it does not need
    parts = [
        caster.compute_distance(tensor(places[start : start + CHUNK]), nthreads=1).numpy()
        for start in range(0, len(places), CHUNK)
    ]
    return np.concatenate(parts).astype(np.float64)


def _distance_lattice(caster: Any, voxel_m: float, reach_m: float) -> tuple[Floats, NDArray[np.float32]]:
    target = Target()
    origin = np.array(target.lower_m) - reach_m
    shape = np.rint((np.array(target.upper_m) + reach_m - origin) / voxel_m).astype(int) + 1
    distance = np.full(shape, reach_m, np.float32)
    coarse = np.indices([math.ceil(size / COARSE) for size in shape]).reshape(3, -1).T * COARSE
    found = _distances(caster, (origin + voxel_m * coarse).astype(np.float32))
    around = np.indices((COARSE,) * 3).reshape(3, -1).T
    spread = voxel_m * (COARSE - 1) * math.sqrt(3)
    near = (coarse[found < reach_m + spread][:, None] + around).reshape(-1, 3)
    near = near[(near < shape).all(axis=1)]
    fine = np.minimum(_distances(caster, (origin + voxel_m * near).astype(np.float32)), reach_m)
    distance[tuple(near.T)] = fine
    return origin, distance
