"""The simulated lidar, over a room of six walls."""

from __future__ import annotations

import math

import numpy as np
import pytest

from protocol.geometry import Floats
from protocol.localization_settings import Lidar
from sim_bridge.lidar import directions, measure
from sim_bridge.scenes.lighting import ray_caster

LIDAR = Lidar(rays=2000)
LOW, HIGH = np.array([-3.0, -2.0, 0.0]), np.array([3.0, 2.0, 2.5])
POSE = np.array([0.5, -0.4, 1.2, 0.7, 1.3])


def room() -> np.ndarray:
    """(12, 3, 3) triangles."""
    faces = []
    for axis in range(3):
        for level in (LOW[axis], HIGH[axis]):
            first, second = (k for k in range(3) if k != axis)
            corners = np.zeros((4, 3))
            corners[:, axis] = level
            corners[:, first] = [LOW[first], HIGH[first], HIGH[first], LOW[first]]
            corners[:, second] = [LOW[second], LOW[second], HIGH[second], HIGH[second]]
            faces += [corners[[0, 1, 2]], corners[[0, 2, 3]]]
    return np.array(faces)


def scan(settings: Lidar = LIDAR, pose: Floats = POSE, seed: int = 1) -> Floats:
    dice = np.random.default_rng(seed)
    return measure(ray_caster(room()), directions(dice, settings), pose, settings, dice)


def in_world(points: Floats, pose: Floats = POSE) -> Floats:
    cosine, sine = math.cos(pose[3]), math.sin(pose[3])
    return points @ np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]]) + pose[:3]


def test_points_lie_on_the_walls_but_for_the_noise() -> None:
    points = in_world(scan())
    walls = np.minimum(np.abs(points - LOW), np.abs(points - HIGH)).min(axis=1)
    assert len(points) == LIDAR.rays
    assert np.sqrt(np.square(walls).mean()) < LIDAR.range_noise_m
    assert walls.max() < 5 * LIDAR.range_noise_m
    exact = in_world(scan(LIDAR.model_copy(update={"range_noise_m": 0.0})))
    assert np.minimum(np.abs(exact - LOW), np.abs(exact - HIGH)).min(axis=1).max() < 1e-5


def test_rays_fill_the_sensor_s_part_of_the_sphere_evenly_and_no_more() -> None:
    rays = directions(np.random.default_rng(0), Lidar(rays=20_000))
    elevation = np.arcsin(rays[:, 2])
    assert np.linalg.norm(rays, axis=1) == pytest.approx(1.0)
    assert elevation.min() >= LIDAR.elevation_rad[0]
    assert elevation.max() <= LIDAR.elevation_rad[1]
    counts, _ = np.histogram(np.arctan2(rays[:, 1], rays[:, 0]), 8, (-math.pi, math.pi))
    assert counts == pytest.approx(2500, rel=0.1)
    bands, _ = np.histogram(rays[:, 2], 5, [math.sin(angle) for angle in LIDAR.elevation_rad])
    assert bands == pytest.approx(4000, rel=0.1)


def test_no_two_scans_are_alike_and_each_can_be_repeated() -> None:
    assert np.array_equal(scan(seed=3), scan(seed=3))
    assert not np.array_equal(scan(seed=3), scan(seed=4))


def test_what_is_out_of_range_is_not_seen() -> None:
    near = scan(LIDAR.model_copy(update={"range_max_m": 2.0}))
    assert 0 < len(near) < LIDAR.rays
    assert np.linalg.norm(near, axis=1).max() < 2.0
    blind = scan(LIDAR.model_copy(update={"range_min_m": 2.0}))
    assert np.linalg.norm(blind, axis=1).min() > 2.0
    assert len(near) + len(blind) == LIDAR.rays


def test_a_vehicle_that_turned_sees_the_same_walls_turned() -> None:
    turned = np.array([*POSE[:3], POSE[3] + 1.0, POSE[4]])
    exact = LIDAR.model_copy(update={"range_noise_m": 0.0})
    points = in_world(scan(exact, turned), turned)
    assert np.minimum(np.abs(points - LOW), np.abs(points - HIGH)).min(axis=1).max() < 1e-5
