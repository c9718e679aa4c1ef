"""Compiled geometry of convex polygons x heights: signed distances with gradients, and ways past them.

Prisms lie one after the other in flat arrays: the corners of prism k are rows ``firsts[k]`` to ``firsts[k + 1]`` of
``corners`` (m, 2), counter-clockwise; ``outer`` (m,) tells which edge, from each corner on, is no cut through a zone;
``heights`` (n, 2) are its lowest and highest z, where -inf and inf are no faces at all.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from protocol.geometry import Floats

Flags = NDArray[np.bool_]
Counts = NDArray[np.int64]

_AT = 1e-12
"""Metres: nearer to an edge there is no direction away from its nearest point, and the edge's normal is taken."""


@njit(cache=True, nogil=True)
def _flat_distance(x: float, y: float, corners: Floats, outer: Flags) -> tuple[float, float, float]:
    """Signed distance of (x, y) from a convex polygon and its gradient: outside to the nearest point, inside, negative,
    to the nearest outer edge."""
    deepest, nearest = -math.inf, math.inf
    inside, any_outer = True, outer.any()
    deep_x, deep_y, near_x, near_y = 0.0, 0.0, 0.0, 0.0
    count = corners.shape[0]
    for k in range(count):
        ax, ay = corners[k, 0], corners[k, 1]
        ex, ey = corners[(k + 1) % count, 0] - ax, corners[(k + 1) % count, 1] - ay
        length = math.hypot(ex, ey)
        side = ((x - ax) * ey - (y - ay) * ex) / length
        inside = inside and side <= 0.0
        if (outer[k] or not any_outer) and side > deepest:
            deepest, deep_x, deep_y = side, ey / length, -ex / length
        share = min(max(((x - ax) * ex + (y - ay) * ey) / (length * length), 0.0), 1.0)
        away_x, away_y = x - ax - share * ex, y - ay - share * ey
        distance = math.hypot(away_x, away_y)
        if distance < nearest:
            nearest, near_x, near_y = distance, away_x, away_y
            if distance < _AT:
                near_x, near_y = ey / length, -ex / length
    if inside:
        return deepest, deep_x, deep_y
    scale = max(math.hypot(near_x, near_y), _AT)
    return nearest, near_x / scale, near_y / scale


@njit(cache=True, nogil=True)
def prism_distance(
    x: float, y: float, z: float, corners: Floats, outer: Flags, low: float, high: float
) -> tuple[float, float, float, float]:
    """Signed distance of a point from one convex prism and its gradient, of length 1; negative inside."""
    flat, flat_x, flat_y = _flat_distance(x, y, corners, outer)
    below, above = low - z, z - high
    level, up = (above, 1.0) if above >= below else (below, -1.0)
    if flat <= 0.0 and level <= 0.0:
        if level > flat:
            return level, 0.0, 0.0, up
        return flat, flat_x, flat_y, 0.0
    flat, level = max(flat, 0.0), max(level, 0.0)
    distance = math.hypot(flat, level)
    return distance, flat_x * flat / distance, flat_y * flat / distance, up * level / distance


@njit(cache=True, nogil=True)
def near_zones(
    point: Floats,
    sides: Floats,
    firsts: Counts,
    corners: Floats,
    outer: Flags,
    heights: Floats,
    keep_m: float,
    reach_m: float,
) -> tuple[Counts, Floats, Floats]:
    """Barriers at ``point`` (3,): of half-spaces, rows n_x, n_y, offset of ``sides`` (m, 3), what is left to the
    offset; of prisms, the distance less ``keep_m``.

    Of those below ``reach_m``, and of the smallest one whatever it is: numbers (k,), the half-spaces first; values
    (k,); gradients (k, 5), by pose.
    """
    straight = sides.shape[0]
    count = straight + firsts.size - 1
    values, gradients = np.empty(count), np.zeros((count, 5))
    for k in range(straight):
        values[k] = sides[k, 2] - sides[k, 0] * point[0] - sides[k, 1] * point[1]
        gradients[k, 0], gradients[k, 1] = -sides[k, 0], -sides[k, 1]
    for k in range(count - straight):
        own = slice(firsts[k], firsts[k + 1])
        distance, x, y, z = prism_distance(
            point[0], point[1], point[2], corners[own], outer[own], heights[k, 0], heights[k, 1]
        )
        values[straight + k] = distance - keep_m
        gradients[straight + k, 0], gradients[straight + k, 1], gradients[straight + k, 2] = x, y, z
    chosen = np.flatnonzero(values <= max(reach_m, values.min()))
    return chosen, values[chosen], gradients[chosen]


@njit(cache=True, nogil=True)
def least_distances(points: Floats, firsts: Counts, corners: Floats, outer: Flags, heights: Floats) -> Floats:
    """(p,) signed distance of each of ``points`` (p, 3) from the nearest prism; inf without any."""
    least = np.full(points.shape[0], math.inf)
    for k in range(firsts.size - 1):
        own = slice(firsts[k], firsts[k + 1])
        for p in range(points.shape[0]):
            distance, _, _, _ = prism_distance(
                points[p, 0], points[p, 1], points[p, 2], corners[own], outer[own], heights[k, 0], heights[k, 1]
            )
            least[p] = min(least[p], distance)
    return least


@njit(cache=True, nogil=True)
def _segment_gap(a: Floats, b: Floats, c: Floats, d: Floats) -> float:
    """Distance of two segments in the plane; 0 where they cross."""
    one = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    other = (b[0] - a[0]) * (d[1] - a[1]) - (b[1] - a[1]) * (d[0] - a[0])
    if one * other < 0.0:
        three = (d[0] - c[0]) * (a[1] - c[1]) - (d[1] - c[1]) * (a[0] - c[0])
        four = (d[0] - c[0]) * (b[1] - c[1]) - (d[1] - c[1]) * (b[0] - c[0])
        if three * four < 0.0:
            return 0.0
    gap = min(_point_gap(a, c, d), _point_gap(b, c, d))
    return min(gap, _point_gap(c, a, b), _point_gap(d, a, b))


@njit(cache=True, nogil=True)
def _point_gap(p: Floats, a: Floats, b: Floats) -> float:
    ex, ey = b[0] - a[0], b[1] - a[1]
    square = ex * ex + ey * ey
    share = 0.0
    if square > 0.0:
        share = min(max(((p[0] - a[0]) * ex + (p[1] - a[1]) * ey) / square, 0.0), 1.0)
    return math.hypot(p[0] - a[0] - share * ex, p[1] - a[1] - share * ey)


@njit(cache=True, nogil=True)
def flat_distances(point: Floats, firsts: Counts, corners: Floats, outer: Flags) -> Floats:
    """(n,) horizontal distances of ``point`` (2,) from every prism; 0 inside."""
    distances = np.empty(firsts.size - 1)
    for k in range(distances.size):
        own = slice(firsts[k], firsts[k + 1])
        distances[k] = max(0.0, _flat_distance(point[0], point[1], corners[own], outer[own])[0])
    return distances


@njit(cache=True, nogil=True)
def is_clear(start: Floats, end: Floats, needed: Floats, active: Flags, firsts: Counts, corners: Floats) -> bool:
    """Whether the straight level way from ``start`` to ``end`` (2,), both outside, keeps ``needed`` (n,) from all
    ``active`` (n,) prisms."""
    for k in range(needed.size):
        if not active[k]:
            continue
        own = corners[firsts[k] : firsts[k + 1]]
        for i in range(own.shape[0]):
            if _segment_gap(start, end, own[i], own[(i + 1) % own.shape[0]]) < needed[k]:
                return False
    return True


@njit(cache=True, nogil=True)
def clear_pairs(points: Floats, free: Flags, needed: Floats, active: Flags, firsts: Counts, corners: Floats) -> Flags:
    """(p, p) above the diagonal: between which of ``points`` (p, 2), of those that are ``free`` (p,), a level way is
    clear."""
    count = points.shape[0]
    clear = np.zeros((count, count), np.bool_)
    for i in range(count):
        for j in range(i + 1, count):
            if free[i] and free[j]:
                clear[i, j] = is_clear(points[i], points[j], needed, active, firsts, corners)
    return clear
