"""Which points of a scene's surface can be seen at all, and which from where a mission's drones may be.

Rays leave each point in many directions, the same for all points: one direction at a time, so that rays run side by
side, and only for points not yet known to be seen. A point is seen if a ray passes a free place of a grid before it
meets another surface.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import label

from protocol.airspace import airspace_of
from protocol.geometry import Floats, camera_rotation
from protocol.map_settings import Camera
from protocol.mission import Box, Mission
from sim_bridge.scenes.lighting import even_directions, ray_caster
from sim_bridge.scenes.scene import Scene

CLEARANCE_M = 0.25
"""A drone's radius: no camera comes nearer to a surface."""
CLEARANCE_GRID_M = 0.1
STEEPEST_INCIDENCE_RAD = math.radians(83)
"""Surface seen more from the side than this gives no depth."""
OPEN_M = 0.04
"""A place in the open keeps this distance from all surfaces, and is reached from above through such places."""
OPEN_GRID_M = 0.06
DIRECTIONS = 96
"""Tried for each point: over the sphere for exposed, over the directions that a camera allows for visible."""
OFFSET_M = 1e-3
"""Rays start so far in front of the surface."""


@dataclass(frozen=True, slots=True)
class _Places:
    free: NDArray[np.bool_]
    """[x, y, z]"""
    origin: Floats
    spacing: float

    def at(self, chosen: NDArray[np.bool_]) -> Floats:
        """Positions (n, 3) of those that are ``chosen`` [x, y, z]."""
        return self.origin + self.spacing * np.argwhere(chosen)


def exposed_points(scene: Scene, box: Box, points: NDArray[np.float32], faces: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether points [N, 3] in ``box``, on triangles ``faces`` [N], are seen from some place in the open there."""
    margin = np.full(3, 3 * OPEN_GRID_M)
    places = _free_places(scene, np.array(box.lower_m) - margin, np.array(box.upper_m) + margin, OPEN_GRID_M, OPEN_M)
    regions, _ = label(places.free)
    outside = np.unique(regions[:, :, -1])
    places = _Places(places.free & np.isin(regions, outside), places.origin, places.spacing)
    return _seen(scene, points, faces, even_directions(DIRECTIONS, -1.0), math.pi / 2, places)


def visible_points(
    scene: Scene, mission: Mission, points: NDArray[np.float32], faces: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Whether points [N, 3] on triangles ``faces`` [N] are in view, unhidden, from a pose that ``mission`` allows."""
    flight = mission.flight
    lowest, highest = depression_range(mission.camera, flight.pitch_limits_rad)
    low, high = math.sin(lowest), math.sin(highest)
    upwards = even_directions(math.ceil(DIRECTIONS * (1 - low) / (high - low)), low)
    upwards = upwards[upwards[:, 2] <= high]
    places = _free_places(scene, np.array(flight.lower_m), np.array(flight.upper_m), CLEARANCE_GRID_M, CLEARANCE_M)
    airspace = airspace_of(flight)
    if not airspace.is_open:
        places.free[places.free] = airspace.margins(places.at(places.free)) >= 0
    return _seen(scene, points, faces, upwards, STEEPEST_INCIDENCE_RAD, places)


def depression_range(camera: Camera, pitch_limits_rad: tuple[float, float]) -> tuple[float, float]:
    """Smallest and largest depression of a line of sight within the image, over all allowed pitches, rad."""
    intrinsics = camera.intrinsics()
    columns, rows = np.meshgrid(np.linspace(0, intrinsics.width, 33), np.linspace(0, intrinsics.height, 33))
    rays = np.stack(
        [(columns - intrinsics.cx) / intrinsics.fx, (rows - intrinsics.cy) / intrinsics.fy, np.ones_like(rows)], axis=-1
    )
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    sines = [-(rays @ camera_rotation(0.0, pitch).T)[..., 2] for pitch in np.linspace(*pitch_limits_rad, 17)]
    return math.asin(np.clip(np.min(sines), -1, 1)), math.asin(np.clip(np.max(sines), -1, 1))


def _free_places(scene: Scene, lower: Floats, upper: Floats, spacing: float, distance_m: float) -> _Places:
    """Grid over a box: which places are ``distance_m`` away from every surface."""
    axes = [np.arange(low, high + spacing / 2, spacing) for low, high in zip(lower, upper, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).astype(np.float32)
    distance = ray_caster(scene.triangles).compute_distance(grid).numpy()
    return _Places(np.ascontiguousarray(distance >= distance_m), lower, spacing)


def _seen(
    scene: Scene,
    points: NDArray[np.float32],
    faces: NDArray[np.int64],
    directions: Floats,
    steepest_rad: float,
    places: _Places,
) -> NDArray[np.bool_]:
    """Points from which a ray, at most ``steepest_rad`` from the normal, passes a free place before it ends."""
    caster = ray_caster(scene.triangles)
    exact = scene.triangles.astype(np.float64)
    normals = np.cross(exact[:, 1] - exact[:, 0], exact[:, 2] - exact[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    own, both_sides = normals[faces].astype(np.float32), scene.two_sided[faces]
    seen = np.zeros(len(points), dtype=np.bool_)
    unseen = np.arange(len(points))
    # Shuffled, so that the first few directions already look everywhere.
    for direction in np.random.default_rng(0).permutation(directions).astype(np.float32):
        cosine = own[unseen] @ direction
        facing = np.where(both_sides[unseen], np.abs(cosine), cosine) > math.cos(steepest_rad)
        tried, side = unseen[facing], np.sign(cosine[facing])
        rays = np.empty((len(tried), 6), dtype=np.float32)
        rays[:, :3] = points[tried] + (np.float32(OFFSET_M) * side)[:, None] * own[tried]
        rays[:, 3:] = direction
        length = caster.cast_rays(rays)["t_hit"].numpy()
        seen[tried] = _passes_free_place(rays, length, places.free, places.origin, places.spacing)
        unseen = unseen[~seen[unseen]]
    return seen


@njit(cache=True, nogil=True)
def _passes_free_place(
    rays: NDArray[np.float32],
    lengths: NDArray[np.float32],
    free: NDArray[np.bool_],
    origin: Floats,
    spacing: float,
) -> NDArray[np.bool_]:
    """Whether each ray [n, 6] passes a free place of the grid before it ends, tried at steps of the grid's spacing."""
    passes = np.zeros(len(rays), dtype=np.bool_)
    for ray in range(len(rays)):
        start, direction = rays[ray, :3], rays[ray, 3:]
        begin, end = 0.0, float(lengths[ray])
        for axis in range(3):
            low = origin[axis] - start[axis]
            high = low + (free.shape[axis] - 1) * spacing
            if abs(direction[axis]) < 1e-9:
                if low > 0.0 or high < 0.0:
                    end = -1.0
                continue
            one, other = low / direction[axis], high / direction[axis]
            begin, end = max(begin, min(one, other)), min(end, max(one, other))
        along = begin
        while along <= end:
            x = round((start[0] + along * direction[0] - origin[0]) / spacing)
            y = round((start[1] + along * direction[1] - origin[1]) / spacing)
            z = round((start[2] + along * direction[2] - origin[2]) / spacing)
            if free[x, y, z]:
                passes[ray] = True
                break
            along += spacing
    return passes
