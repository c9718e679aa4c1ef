"""The pose that is sent with a simulated keyframe may be off by a known noise; its image is that of the true one."""

from __future__ import annotations

import math

import numpy as np
import pytest

from protocol.geometry import Floats, camera_rotation, rotation_vector
from protocol.map_settings import Camera as CameraSettings
from protocol.messages import Keyframe
from protocol.mission import Drone, Mission, Simulation
from sim_bridge.camera import Camera
from sim_bridge.photographer import Photographer, Shot, Sight
from sim_bridge.scenes.scene import pack_scene
from sim_bridge.scenes.surfaces import Material, join, quad

POSE = np.array([0.2, -0.1, 1.5, 0.4, 1.3])
DRONES = tuple(Drone(id=k, start=(2.0 * k, 0.0, 2.0, 0.0, 1.3)) for k in (1, 2))


def photographer(noise_m: float = 0.0, noise_rad: float = 0.0, seed: int = 1) -> Photographer:
    mission = Mission(
        seed=seed,
        camera=CameraSettings(width_px=32, height_px=32),
        simulation=Simulation(pose_noise_m=noise_m, pose_noise_rad=noise_rad),
        drones=DRONES,
    )
    corners = [(-5.0, -5.0, 0.0), (5.0, -5.0, 0.0), (5.0, 5.0, 0.0), (-5.0, 5.0, 0.0)]
    scene = pack_scene(join((quad(corners, Material(0)),)), [np.full((4, 4, 3), 128, np.uint8)])
    return Photographer(mission, Camera(scene, mission.camera.intrinsics()))


def take(taker: Photographer, sequence: int = 0, drone: int = 1) -> Keyframe:
    return taker.take(Shot(Sight(drone, 5 * sequence, POSE, POSE), sequence))


def errors(keyframe: Keyframe) -> Floats:
    """(6,) m and rad."""
    turn = np.array(keyframe.rotation) @ camera_rotation(POSE[3], POSE[4]).T
    return np.concatenate([np.array(keyframe.position) - POSE[:3], rotation_vector(turn)])


def test_without_noise_the_pose_is_the_true_one() -> None:
    keyframe = take(photographer())
    assert keyframe.position == tuple(POSE[:3])
    assert np.array(keyframe.rotation) == pytest.approx(camera_rotation(POSE[3], POSE[4]), abs=1e-12)


def test_errors_have_the_wished_deviation_on_every_axis_and_no_bias() -> None:
    taker = photographer(0.02, math.radians(0.5))
    found = np.array([errors(take(taker, sequence)) for sequence in range(400)]) / (
        [0.02] * 3 + [math.radians(0.5)] * 3
    )
    assert found.std(axis=0) == pytest.approx(np.ones(6), abs=0.12)
    assert found.mean(axis=0) == pytest.approx(np.zeros(6), abs=0.2)
    assert np.abs(np.corrcoef(found.T) - np.eye(6)).max() < 0.2


def test_an_error_depends_on_seed_drone_and_sequence_alone() -> None:
    taker = photographer(0.02, 0.01)
    first = take(taker, 3)
    assert take(photographer(0.02, 0.01), 3) == first
    others = take(taker, 4), take(taker, 3, drone=2), take(photographer(0.02, 0.01, seed=2), 3)
    assert len({first.position, *(other.position for other in others)}) == 4


def test_the_image_is_the_same_with_noise_and_without() -> None:
    assert take(photographer(0.05, 0.05), 7).jpeg == take(photographer(), 7).jpeg
