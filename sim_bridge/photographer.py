"""Takes the simulated drones' keyframes: when they are due, rendered, made noisy, and compressed as a camera would.

The pose that is sent with one may be off, as that of a real vehicle is.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from PIL import Image

from protocol.depth_image import encode_depth
from protocol.geometry import Floats, camera_rotation, turn_matrix
from protocol.keyframe_rule import KeyframeRule, make_keyframe
from protocol.messages import Keyframe
from protocol.mission import Mission
from sim_bridge.camera import Camera, add_depth_noise, add_noise
from sim_bridge.exposure import expose

POSE_STREAM: Final = 1
"""Random numbers of poses are drawn apart, so that the images do not depend on them."""


@dataclass(frozen=True, slots=True)
class Shot:
    """A keyframe that is due but not rendered yet."""

    sight: Sight
    sequence: int

    @property
    def drone(self) -> int:
        return self.sight.drone


@dataclass(frozen=True, slots=True)
class Sight:
    """Where a drone's camera is at a tick, and where its drone believes it to be."""

    drone: int
    tick: int
    truth: Floats
    """(5,)"""
    believed: Floats
    """(5,)"""
    deviations: tuple[float, float] = (0.0, 0.0)
    """Standard deviations of what is believed, m and rad."""
    velocity: Floats = field(default_factory=lambda: np.zeros(5))
    """(5,) the true one, by which images blur."""


class Photographer:
    def __init__(self, mission: Mission, camera: Camera, depth_camera: Camera | None = None) -> None:
        """``depth_camera``: of the mission's `sweep_intrinsics`; None: keyframes carry no depth."""
        self._mission, self._camera, self._depth_camera = mission, camera, depth_camera
        self._intrinsics = mission.camera.intrinsics()
        self._rules = {drone.id: KeyframeRule(mission.camera) for drone in mission.drones}
        self._taken = dict.fromkeys(self._rules, 0)

    def due(self, tick: int, poses: Mapping[int, Floats], velocities: Mapping[int, Floats] | None = None) -> list[Shot]:
        """The drones, ascending, whose camera has moved enough since its last keyframe; ``poses`` and ``velocities``
        are (5,), and who has none of these stands still."""
        moving = velocities or {}
        return self.due_of(
            Sight(drone, tick, pose, pose, velocity=moving.get(drone, np.zeros(5)))
            for drone, pose in sorted(poses.items())
        )

    def due_of(self, sights: Iterable[Sight]) -> list[Shot]:
        """Likewise, of cameras that believe that they have moved enough."""
        shots = []
        for sight in sights:
            pose = sight.believed
            if self._rules[sight.drone].wants(pose[:3], camera_rotation(pose[3], pose[4])):
                kept = replace(sight, truth=sight.truth.copy(), believed=pose.copy(), velocity=sight.velocity.copy())
                shots.append(Shot(kept, self._taken[sight.drone]))
                self._taken[sight.drone] += 1
        return shots

    def take(self, shot: Shot) -> Keyframe:
        """Render one; the noise depends on the mission's seed, the drone and the sequence number alone."""
        settings, sight = self._mission.camera, shot.sight
        exposure_s, distance_m = self._mission.simulation.exposure_s, self._mission.sensing.distance_m
        image = expose(self._camera, sight.truth, sight.velocity, exposure_s, self._intrinsics, distance_m)
        generator = np.random.default_rng([self._mission.seed, shot.drone, shot.sequence])
        if self._mission.simulation.image_noise > 0:
            image = add_noise(image, self._mission.simulation.image_noise, generator)
        jpeg = io.BytesIO()
        Image.fromarray(image).save(jpeg, "JPEG", quality=settings.jpeg_quality)
        position, rotation = self._told_pose(shot)
        return make_keyframe(
            shot.drone,
            shot.sequence,
            sight.tick,
            position,
            rotation,
            self._intrinsics,
            jpeg.getvalue(),
            self._measure_depth(shot, generator),
            sight.deviations,
        )

    def _measure_depth(self, shot: Shot, generator: np.random.Generator) -> bytes:
        """What a depth camera there gives; empty without one."""
        if self._depth_camera is None:
            return b""
        settings = self._mission.simulation
        depth = self._depth_camera.render_depth(shot.sight.truth.tolist())
        return encode_depth(add_depth_noise(depth, settings.depth_noise_m, settings.depth_noise_per_m, generator))

    def _told_pose(self, shot: Shot) -> tuple[Floats, Floats]:
        """The one that is believed, with an error of its own for each keyframe."""
        settings, pose = self._mission.simulation, shot.sight.believed
        position, rotation = pose[:3], camera_rotation(pose[3], pose[4])
        if settings.pose_noise_m == settings.pose_noise_rad == 0:
            return position, rotation
        dice = np.random.default_rng([self._mission.seed, shot.drone, shot.sequence, POSE_STREAM])
        shift, turn = dice.normal(0.0, settings.pose_noise_m, 3), dice.normal(0.0, settings.pose_noise_rad, 3)
        return position + shift, turn_matrix(turn) @ rotation
