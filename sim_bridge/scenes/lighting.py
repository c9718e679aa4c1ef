"""Light that is computed once, when a scene is built: soft sky, a broad key light and what is hidden from both.

Real depth cues (contact shadows, shaded sides) without a light loop per frame. Triangles are split where the light
changes within them, so that shadows have edges and plain walls stay coarse.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from protocol.geometry import Floats
from sim_bridge.scenes.surfaces import Surfaces

SKY_DIRECTIONS = 112
KEY_DIRECTIONS = 32
KEY_AXIS = (0.45, -0.35, 0.82)
"""Towards the key light: high, a bit to the side, as a large window would be."""
KEY_HALF_ANGLE_RAD = math.radians(22)
SKY_COLOUR = (0.52, 0.55, 0.60)
"""Linear irradiance from an unhidden hemisphere."""
KEY_COLOUR = (0.62, 0.57, 0.50)
BOUNCE_COLOUR = (0.42, 0.39, 0.36)
"""What surfaces send back, once they are far from the lit point ..."""
BOUNCE_REACH_M = 0.5
"""... which they darken where they are closer than about this."""
LIFT_M = 2e-3
"""Rays start so far above the surface ..."""
INSET_M = 0.016
"""... so far inside its border, or they would start within the next wall ..."""
CONTACT_M = 0.015
"""... and so far along the ray: the dark under a plate would bleed out over a whole triangle."""

LONGEST_EDGE_M = 1.0
SHORTEST_EDGE_M = 0.1
CONTRAST = 0.05
"""An edge is split where the light at its middle differs by more than this from the mean of its ends."""
MAX_ROUNDS = 12
"""Of splitting: halves a 7 m wall down to the shortest edge and leaves some for the diagonals."""
MAX_RAYS = 60_000_000
"""Bound of the work on large meshes: fewer directions are tried."""
CREASE_COS = math.cos(math.radians(40))
"""Faces that meet at less than this angle are lit as one smooth surface."""

_WELD_M = 1e-5
_EDGE_SHIFT = 32
_SPLITS: tuple[tuple[tuple[int, int, int], ...], ...] = (
    # By which edges are split (1: 01, 2: 12, 4: 20); corners 3, 4, 5 are the middles of edges 01, 12, 20.
    ((0, 1, 2),),
    ((0, 3, 2), (3, 1, 2)),
    ((0, 1, 4), (0, 4, 2)),
    ((3, 1, 4), (0, 3, 4), (0, 4, 2)),
    ((0, 1, 5), (5, 1, 2)),
    ((0, 3, 5), (3, 1, 2), (3, 2, 5)),
    ((4, 2, 5), (0, 1, 4), (0, 4, 5)),
    ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)),
)


@dataclass(frozen=True, slots=True)
class _Sky:
    directions: Floats
    weights: Floats
    """[D, 3] irradiance that an unhidden direction gives a surface facing it."""
    bounces: Floats
    """[D, 3] the same for a direction that ends on a distant surface."""


def bake(surfaces: Surfaces) -> Surfaces:
    """The surfaces split where light needs it, ``colour`` multiplied by the light (display space)."""
    caster = ray_caster(surfaces.triangles)
    points, normals, corners = _lit_places(surfaces)
    share = min(1.0, MAX_RAYS / ((SKY_DIRECTIONS + KEY_DIRECTIONS) * 2 * len(points)))
    sky = _sky(max(24, round(SKY_DIRECTIONS * share)), max(8, round(KEY_DIRECTIONS * share)))

    def light_at(where: Floats, facing: Floats) -> Floats:
        return _gather(caster, sky, where, facing)

    light = light_at(points, normals)
    settled = np.empty(0, dtype=np.int64)
    for _ in range(MAX_ROUNDS):
        ends = np.sort(np.stack([corners, np.roll(corners, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
        edges, inverse = np.unique(ends[:, 0] << _EDGE_SHIFT | ends[:, 1], return_inverse=True)
        first, second = edges >> _EDGE_SHIFT, edges & (1 << _EDGE_SHIFT) - 1
        length = np.linalg.norm(points[first] - points[second], axis=1)
        middle = (points[first] + points[second]) / 2
        facing = normals[first] + normals[second]
        facing /= np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-9)

        tried = (length > SHORTEST_EDGE_M) & ~np.isin(edges, settled, assume_unique=True)
        middle_light = np.zeros_like(middle)
        middle_light[tried] = light_at(middle[tried], facing[tried])
        change = np.abs(middle_light - (light[first] + light[second]) / 2).max(axis=1)
        marked = tried & ((length > LONGEST_EDGE_M) | (change > CONTRAST))
        if not marked.any():
            break
        split = _with_longest(marked, length, inverse.reshape(-1, 3))
        added = split & ~tried
        middle_light[added] = light_at(middle[added], facing[added])
        settled = np.concatenate([settled, edges[tried & ~split]])

        number = np.cumsum(split) - 1 + len(points)
        points = np.concatenate([points, middle[split]])
        normals = np.concatenate([normals, facing[split]])
        light = np.concatenate([light, middle_light[split]])
        surfaces, corners = _split(surfaces, corners, split[inverse].reshape(-1, 3), number[inverse].reshape(-1, 3))
    return Surfaces(
        surfaces.triangles, surfaces.uv, surfaces.colour * light[corners], surfaces.texture, surfaces.two_sided
    )


def ray_caster(triangles: NDArray[np.floating]) -> Any:
    """Open3D's RaycastingScene of [T, 3, 3] corners; primitive t is triangle t."""
    import open3d as o3d  # slow to import, and not needed where everything comes from the cache

    caster = o3d.t.geometry.RaycastingScene()
    vertices = triangles.reshape(-1, 3).astype(np.float32)
    rows = np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3)
    tensor: Any = o3d.core.Tensor  # its stubs demand a dtype and a device that it does not need
    caster.add_triangles(tensor(vertices), tensor(rows))
    return caster


def _sky(sky_count: int, key_count: int) -> _Sky:
    axis = np.array(KEY_AXIS) / np.linalg.norm(KEY_AXIS)
    everywhere = even_directions(sky_count, -1.0)
    key = even_directions(key_count, math.cos(KEY_HALF_ANGLE_RAD))
    across = np.cross(axis, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    key = key @ np.stack([across, np.cross(axis, across), axis])
    # The mean of max(0, cosine) over the sphere is 1/4: with it a free plane gets the colours as written.
    even = np.full((sky_count, 1), 4.0 / sky_count)
    above = (everywhere[:, 2:] > 0) * even
    below = (everywhere[:, 2:] <= 0) * even
    return _Sky(
        np.concatenate([everywhere, key]),
        np.concatenate(
            [above * SKY_COLOUR + below * BOUNCE_COLOUR, np.full((key_count, 1), 1 / key_count) * KEY_COLOUR]
        ),
        np.concatenate([even * BOUNCE_COLOUR, np.zeros((key_count, 3))]),
    )


def even_directions(count: int, lowest_z: float) -> Floats:
    """Even directions (Fibonacci spiral) over the part of the unit sphere with z > ``lowest_z``, [count, 3]."""
    z = 1.0 - (1.0 - lowest_z) * (np.arange(count) + 0.5) / count
    angle = np.arange(count) * math.pi * (3.0 - math.sqrt(5.0))
    radius = np.sqrt(1.0 - z * z)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])


def _gather(caster: Any, sky: _Sky, points: Floats, normals: Floats) -> Floats:
    """Light in display space (gamma 2.2), [n, 3]."""
    total = np.zeros((len(points), 3))
    origins = points.astype(np.float32)
    for direction, weight, bounce in zip(sky.directions, sky.weights, sky.bounces, strict=True):
        cosine = normals @ direction
        seen = np.flatnonzero(cosine > 0)
        rays = np.empty((len(seen), 6), dtype=np.float32)
        rays[:, :3] = origins[seen] + (CONTACT_M * direction).astype(np.float32)
        rays[:, 3:] = direction
        distance = caster.cast_rays(rays)["t_hit"].numpy()
        reach = 1.0 - np.exp(-distance / BOUNCE_REACH_M)
        incoming = np.where(np.isinf(distance)[:, None], weight, reach[:, None] * bounce)
        total[seen] += cosine[seen, None] * incoming
    return total ** (1 / 2.2)


def _lit_places(surfaces: Surfaces) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """Where light is computed, [V, 3], the normals there [V, 3], and which one each corner uses, [T, 3]."""
    triangles = surfaces.triangles
    areas = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    # What is drawn from both sides is lit from above.
    areas[surfaces.two_sided & (areas[:, 2] < 0)] *= -1
    flat = np.round(triangles.reshape(-1, 3) / _WELD_M).astype(np.int64)
    _, place = np.unique(flat, axis=0, return_inverse=True)
    order = np.argsort(place, kind="stable")
    normals = _smooth_normals(areas, place, order)
    keys = np.column_stack([place, np.round(normals * 1000).astype(np.int64)])
    _, first, corners = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    inwards = (triangles.mean(axis=1, keepdims=True) - triangles).reshape(-1, 3)
    inset = np.zeros((len(first), 3))
    np.add.at(inset, corners, inwards)
    inset /= np.bincount(corners)[:, None]
    inset -= np.einsum("ij,ij->i", inset, normals[first])[:, None] * normals[first]  # along the surface
    inset *= np.minimum(0.5, INSET_M / np.maximum(np.linalg.norm(inset, axis=1, keepdims=True), 1e-9))
    points = triangles.reshape(-1, 3)[first] + LIFT_M * normals[first] + inset
    return points, normals[first], corners.reshape(-1, 3)


@njit(cache=True, nogil=True)
def _smooth_normals(areas: Floats, place: NDArray[np.int64], order: NDArray[np.int64]) -> Floats:
    """Unit normal of each corner, [3 T, 3]: area-weighted over the faces at its place that are within the crease."""
    normals = np.zeros((len(place), 3))
    lengths = np.sqrt((areas * areas).sum(axis=1))
    start = 0
    while start < len(order):
        stop = start
        while stop < len(order) and place[order[stop]] == place[order[start]]:
            stop += 1
        for one in order[start:stop]:
            own = areas[one // 3]
            for other in order[start:stop]:
                theirs = areas[other // 3]
                cosine = own[0] * theirs[0] + own[1] * theirs[1] + own[2] * theirs[2]
                if cosine >= CREASE_COS * lengths[one // 3] * lengths[other // 3]:
                    normals[one] += theirs
            length = math.sqrt((normals[one] * normals[one]).sum())
            if length > 0:
                normals[one] /= length
        start = stop
    return normals


def _with_longest(split: NDArray[np.bool_], length: Floats, edges: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Marks with the longest edge of every touched triangle added (Rivara 1984): without it slivers never end."""
    longest = edges[np.arange(len(edges)), length[edges].argmax(axis=1)]
    while True:
        missing = split[edges].any(axis=1) & ~split[longest]
        if not missing.any():
            return split
        split = split.copy()
        split[longest[missing]] = True


def _split(
    surfaces: Surfaces, corners: NDArray[np.int64], split: NDArray[np.bool_], middles: NDArray[np.int64]
) -> tuple[Surfaces, NDArray[np.int64]]:
    """Triangles cut at the marked edges (01, 12, 20), [T, 3]; ``middles`` names the new vertices."""
    pattern = split @ np.array([1, 2, 4])
    triangles, uv, colour, texture, two_sided, indices = [], [], [], [], [], []
    for case, parts in enumerate(_SPLITS):
        chosen = np.flatnonzero(pattern == case)
        six = np.concatenate([corners[chosen], middles[chosen]], axis=1)
        for part in parts:
            picked = list(part)
            triangles.append(_with_middles(surfaces.triangles[chosen])[:, picked])
            uv.append(_with_middles(surfaces.uv[chosen])[:, picked])
            colour.append(_with_middles(surfaces.colour[chosen])[:, picked])
            texture.append(surfaces.texture[chosen])
            two_sided.append(surfaces.two_sided[chosen])
            indices.append(six[:, picked])
    finer = Surfaces(
        np.concatenate(triangles),
        np.concatenate(uv),
        np.concatenate(colour),
        np.concatenate(texture),
        np.concatenate(two_sided),
    )
    return finer, np.concatenate(indices)


def _with_middles(corners: Floats) -> Floats:
    """[n, 3, k] -> [n, 6, k]: the corners, then the middles of edges 01, 12, 20."""
    return np.concatenate([corners, (corners + np.roll(corners, -1, axis=1)) / 2], axis=1)
