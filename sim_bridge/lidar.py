"""The simulated lidar: a non-repetitive one, whose rays go elsewhere in every scan, over a scene's triangles.

Each scan is taken at one moment. A real one sweeps for a tenth of a second; at the speeds flown here that smears it by
some centimetres, which its driver has to undo.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.geometry import Floats
from protocol.localization_settings import Lidar
from protocol.messages import LidarScan
from sim_bridge.scenes.lighting import ray_caster
from sim_bridge.scenes.scene import Scene

LIDAR_STREAM = 11
"""Keeps the draws of scans apart from others that are made from the same seed."""
MILLIMETRE = 1e-3


class LidarSensor:
    """Of all drones. Not for two threads at once."""

    def __init__(self, scene: Scene, settings: Lidar, seed: int) -> None:
        self._caster = ray_caster(scene.triangles)
        self._settings, self._seed = settings, seed

    def scan(self, drone: int, tick: int, pose: Floats) -> LidarScan:
        """What the sensor of ``drone`` measures at ``pose`` (5,); directions and noise depend on the mission's seed,
        the drone and the tick alone."""
        generator = np.random.default_rng([self._seed, LIDAR_STREAM, drone, tick])
        rays = directions(generator, self._settings)
        points = measure(self._caster, rays, pose, self._settings, generator)
        return LidarScan(drone=drone, tick=tick, points=np.rint(points / MILLIMETRE).astype(np.int16))


def directions(generator: np.random.Generator, settings: Lidar) -> Floats:
    """Unit vectors (rays, 3), x forward, y left, z up, spread evenly over the sensor's part of the sphere."""
    low, high = (math.sin(angle) for angle in settings.elevation_rad)
    height = generator.uniform(low, high, settings.rays)
    azimuth = generator.uniform(-math.pi, math.pi, settings.rays)
    across = np.sqrt(1 - height * height)
    return np.column_stack([across * np.cos(azimuth), across * np.sin(azimuth), height])


def measure(caster: Any, rays: Floats, pose: Floats, settings: Lidar, generator: np.random.Generator) -> Floats:
    """Points (n, 3) where ``rays`` (rays, 3) from ``pose`` (5,) meet a surface within range, in the levelled frame of
    the airframe, x forward; ``caster`` is `sim_bridge.scenes.lighting.ray_caster`'s."""
    cosine, sine = math.cos(pose[3]), math.sin(pose[3])
    turned: NDArray[np.float32] = np.empty((len(rays), 6), np.float32)
    turned[:, :3] = pose[:3]
    turned[:, 3:] = rays @ np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])
    ranges = caster.cast_rays(turned, nthreads=1)["t_hit"].numpy().astype(np.float64)
    ranges += generator.normal(0.0, settings.range_noise_m, len(rays))
    seen = (ranges > settings.range_min_m) & (ranges < settings.range_max_m)
    points: Floats = rays[seen] * ranges[seen, None]
    return points
