"""Two boxes on a floor, and what cameras see of them: the world that every reconstructor is tried on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ground_station.reconstruction.reconstructor import Keyframe, Mesh
from protocol.geometry import Floats, Intrinsics, camera_rotation
from protocol.map_settings import Camera, Reconstruction
from protocol.mission import Drone, Mission, Target

CAMERA = Camera(width_px=160, height_px=90)
DEPTH_PX = (96, 54)
"""Width and height of a depth image."""
BOXES = (((-0.45, -0.35, 0.0), (0.05, 0.25, 0.35)), ((0.4, -0.2, 0.0), (0.8, 0.4, 0.5)))
SETTINGS = Reconstruction(
    sweep_width_px=DEPTH_PX[0], depth_planes=32, nearest_m=0.6, farthest_m=2.5, external_patience_s=30.0
)
LEG = 14
"""Keyframes of one drone's flight over the boxes."""
REFINED = ", poses refined"
"""After a backend's name: with ``refine_poses``."""
NEAR_M = 0.025
"""A voxel: so far from the surface a vertex is right."""


def mission(backend: str = "plane_sweep", workers: int = 1) -> Mission:
    changes = {"backend": backend.removesuffix(REFINED), "refine_poses": backend.endswith(REFINED), "workers": workers}
    return Mission(
        target=Target(lower_m=(-1, -1, 0), upper_m=(1, 1, 0.8)),
        camera=CAMERA,
        reconstruction=SETTINGS.model_copy(update=changes),
        drones=(Drone(id=1, start=(0, 0, 2, 0, 1.4)),),
    )


def keyframe(sequence: int, x: float, y: float, drone: int = 1, yaw: float = 0.0) -> Keyframe:
    position = np.array([x, y, 1.4 + 0.05 * np.sin(sequence)])
    rotation = camera_rotation(yaw + 0.1 * np.sin(2.0 * sequence), 1.35 + 0.1 * np.sin(sequence))
    camera = CAMERA.intrinsics()
    image, _ = photograph(position, rotation, camera)
    _, depth = photograph(position, rotation, camera.scaled_to(*DEPTH_PX))
    return Keyframe(drone, sequence, 5 * sequence, image, position, rotation, camera, depth)


def fly_over() -> list[Keyframe]:
    """Two drones on parallel lines over the boxes, their keyframes interleaved as they arrive."""
    pairs = [
        (keyframe(n, -0.8 + 0.12 * n, -0.1), keyframe(n, 0.8 - 0.12 * n, 0.15, drone=2, yaw=2.0)) for n in range(LEG)
    ]
    return [one for pair in pairs for one in pair]


def photograph(position: Floats, rotation: Floats, camera: Intrinsics) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """RGB image (H, W, 3) and depth (H, W) m of the floor z = 0 and the boxes."""
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones_like(rows)], axis=-1)
    rays = rays @ rotation.T
    depth, side = -position[2] / rays[..., 2], np.full(rows.shape, 2)
    for lower, upper in BOXES:
        one, two = (np.array(lower) - position) / rays, (np.array(upper) - position) / rays
        entry = np.minimum(one, two)
        hit = (entry.max(axis=-1) < np.maximum(one, two).min(axis=-1)) & (entry.max(axis=-1) > 0)
        depth, side = np.where(hit, entry.max(axis=-1), depth), np.where(hit, entry.argmax(axis=-1), side)
    points = position + depth[..., None] * rays
    across = np.where(side == 0, points[..., 1], points[..., 0])
    along = np.where(side == 2, points[..., 1] + points[..., 2], points[..., 2] + 7.0)
    grey = np.clip(_texture(across, along), 0, 255)
    return np.stack([grey, 0.8 * grey, 0.6 * grey], axis=-1).astype(np.uint8), depth.astype(np.float32)


def _texture(x: Floats, y: Floats) -> Floats:
    rng = np.random.default_rng(3)
    total = np.full_like(x, 128.0)
    for _ in range(24):
        direction, phase = rng.uniform(0, 2 * np.pi, 2)
        wave = 2 * np.pi / (0.05 * 10 ** rng.uniform(0, 1))
        total += 14 * np.sin(wave * (x * np.cos(direction) + y * np.sin(direction)) + phase)
    return total


def share_right(mesh: Mesh) -> float:
    """Of the mesh's vertices, away from the rim of the target: those within NEAR_M of the boxes or the floor."""
    inside = mesh.vertices[np.abs(mesh.vertices[:, :2]).max(axis=1) < 0.9].astype(float)
    away = np.abs(inside[:, 2])
    for lower, upper in BOXES:
        outside = np.maximum(np.maximum(np.array(lower) - inside, inside - np.array(upper)), 0.0)
        depth = np.minimum(inside - np.array(lower), np.array(upper) - inside).min(axis=1)
        away = np.minimum(away, np.maximum(np.linalg.norm(outside, axis=1), depth))
    return float(np.mean(away < NEAR_M))
