"""Where drones may be within the flight box: inside the boundary, outside every no-fly zone, with room to spare.

Everything is made of two kinds of obstacle. The convex hull of the boundary is a few half-spaces. What the boundary
lacks of its hull, and every no-fly zone, is cut into convex polygons x heights, prisms. Both give strict rows
grad b . u >= -a b on the predicted position y, which moves as commanded, dy/dt = u (`agents.barriers`):

* half-space: b(y) = offset - n . y, which is linear. The moving average p of y stays in it because it is convex.
* prism: b(y) = dist(y, prism) - D. The distance from a convex set is a convex function, so for a command u that is
  held for a tick of length h, b(y + h u) >= b(y) + h grad b . u >= (1 - a h) b(y): the linear row promises less than
  the barrier keeps, and b >= 0 stays true with nothing lost to curvature. D is the mission's distance d, widened
  because p cuts corners: y stays D away from every single point of the prism, so p stays d away from each, as
  `protocol.separation.widened` shows for one point that is approached at the drone's own top speed.

Where all b >= 0, u = 0 meets every row, so zones alone never leave the quadratic program without an answer.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from protocol.geometry import Floats
from protocol.polygons import Piece, convex_hull, convex_pieces, pockets
from protocol.prisms import Counts, Flags, flat_distances, least_distances, near_zones
from protocol.separation import error_beyond, top_speed, widened
from protocol.zone_settings import BOUNDARY

if TYPE_CHECKING:
    from protocol.mission import Flight

_ROUNDING_M = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Barriers:
    """Barriers of some zones at one point."""

    names: tuple[str, ...]
    values_m: Floats
    """(k,) b; negative: too near."""
    gradients: Floats
    """(k, 5) by pose, of length 1."""
    kept_m: Floats
    """(k,) distance from the zone at which b is 0."""


@dataclass(frozen=True, slots=True, eq=False)
class Airspace:
    """Zones of one mission; the flight box itself is not among them."""

    distance_m: float
    """d: what a drone's estimated position keeps from boundary and zones."""
    wide_m: float
    """D: what its predicted position keeps from prisms."""
    sides: Floats
    """(m, 3) n_x, n_y, offset: n . y <= offset, n of length 1, the offset with d taken off."""
    names: tuple[str, ...]
    """Of the prisms; those of one zone have the same."""
    firsts: Counts
    corners: Floats
    outer: Flags
    heights: Floats
    """These four as in `protocol.prisms`."""
    floor_m: float
    ceiling_m: float

    @property
    def is_open(self) -> bool:
        """Whether there is nothing but the box."""
        return not self.names and not len(self.sides)

    def barriers(self, point: Floats, reach_m: float) -> Barriers:
        """All at the predicted ``point`` (3,) that are below ``reach_m``, and the smallest one whatever it is. Not to
        be asked of an open one."""
        chosen, values, gradients = near_zones(
            point, self.sides, self.firsts, self.corners, self.outer, self.heights, self.wide_m, reach_m
        )
        straight = len(self.sides)
        names = tuple(BOUNDARY if k < straight else self.names[k - straight] for k in chosen.tolist())
        return Barriers(names, values, gradients, np.where(chosen < straight, self.distance_m, self.wide_m))

    def margins(self, points: Floats) -> Floats:
        """(p,) smallest barrier at each of ``points`` (p, 3): not negative where a drone may hover; inf if open."""
        least = least_distances(points, self.firsts, self.corners, self.outer, self.heights) - self.wide_m
        sides = self.sides[:, 2] - points[:, :2] @ self.sides[:, :2].T
        merged: Floats = np.minimum(least, sides.min(axis=1, initial=math.inf))
        return merged

    def inside_m(self, point: Floats) -> float:
        """How far ``point`` (3,) is nearer to a zone, or to the boundary, than d; 0 where it is not."""
        if self.is_open:
            return 0.0
        found = self.barriers(point, 0.0)
        return max(0.0, self.distance_m - float((found.values_m + found.kept_m).min()))

    def fault(self, point: Sequence[float]) -> str:
        """Why no drone may be at ``point`` (x, y, z), or why it could not come down from there; empty if it may."""
        place = np.array(point[:3], float)
        if self.is_open:
            return ""
        found = self.barriers(place, 0.0)
        worst = int(found.values_m.argmin())
        if found.values_m[worst] < -_ROUNDING_M:
            return _too_near(found.names[worst], float(found.values_m[worst]), float(found.kept_m[worst]))
        flat = flat_distances(place[:2], self.firsts, self.corners, self.outer)
        below = np.flatnonzero((flat < self.wide_m - _ROUNDING_M) & (self.heights[:, 0] < place[2]))
        return f"lies above {in_words(self.names[below[0]])}: no drone could land there" if len(below) else ""

    def levels(self, spare_m: float = 0.0) -> list[float]:
        """Heights, ascending, from the floor to the ceiling of the box, between which the same prisms are in the way
        of a drone that keeps D and ``spare_m``."""
        keep = self.wide_m + spare_m
        edges = [*(self.heights[:, 0] - keep).tolist(), *(self.heights[:, 1] + keep).tolist()]
        between = {edge for edge in edges if self.floor_m < edge < self.ceiling_m}
        return sorted({self.floor_m, self.ceiling_m, *between})

    def active(self, height_m: float, spare_m: float = 0.0) -> Flags:
        """(n,) prisms that are in the way at that height."""
        keep = self.wide_m + spare_m
        found: Flags = (self.heights[:, 0] - keep < height_m) & (height_m < self.heights[:, 1] + keep)
        return found


def in_words(zone: str) -> str:
    return "the boundary" if zone == BOUNDARY else f"no-fly zone {zone!r}"


def _too_near(zone: str, barrier_m: float, kept_m: float) -> str:
    gap = barrier_m + kept_m
    where = f"{gap:.2f} m from" if gap >= 0 else "outside" if zone == BOUNDARY else "inside"
    return (
        f"lies {where} {in_words(zone)}; drones keep {kept_m:.2f} m from it,"
        " flight.clearance_m and what lag and position_error_m add"
    )


def airspace_within(flight: Flight, deviation_m: float) -> Airspace:
    """The zones of ``flight`` to a drone that tells this standard deviation of its position: the same, with d grown by
    what it may be off more than the mission says."""
    airspace = airspace_of(flight)
    beyond = error_beyond(flight, deviation_m)
    if beyond <= 0.0:
        return airspace
    distance = airspace.distance_m + beyond
    wide = widened(distance, top_speed(flight) * flight.response_time_s)
    return replace(airspace, distance_m=distance, wide_m=wide, sides=airspace.sides - np.array([0.0, 0.0, beyond]))


@lru_cache(maxsize=64)
def airspace_of(flight: Flight) -> Airspace:
    """The zones of ``flight``, ready to be asked."""
    distance = flight.clearance_m + flight.position_error_m
    floor, ceiling = flight.lower_m[2], flight.upper_m[2]
    pieces = list(_pieces(flight))
    return Airspace(
        distance_m=distance,
        wide_m=widened(distance, top_speed(flight) * flight.response_time_s),
        sides=np.array(list(_sides(flight, distance))).reshape(-1, 3),
        names=tuple(name for name, _, _ in pieces),
        firsts=np.cumsum([0, *(len(piece.corners) for _, piece, _ in pieces)]).astype(np.int64),
        corners=np.array([corner for _, piece, _ in pieces for corner in piece.corners], float).reshape(-1, 2),
        outer=np.array([outer for _, piece, _ in pieces for outer in piece.outer], np.bool_),
        heights=np.array([heights for _, _, heights in pieces], float).reshape(-1, 2),
        floor_m=floor,
        ceiling_m=ceiling,
    )


def _sides(flight: Flight, distance_m: float) -> Iterator[tuple[float, float, float]]:
    if flight.boundary is None:
        return
    hull = convex_hull(flight.boundary)
    for (ax, ay), (bx, by) in pairwise([*hull, hull[0]]):
        length = math.hypot(bx - ax, by - ay)
        nx, ny = (by - ay) / length, (ax - bx) / length
        yield nx, ny, nx * ax + ny * ay - distance_m


def _pieces(flight: Flight) -> Iterator[tuple[str, Piece, tuple[float, float]]]:
    """Name, polygon and heights of every prism. Heights to which nobody flies are no faces: whoever is inside by
    mistake is not to be sent through the floor."""
    for pocket in pockets(flight.boundary or ()) if flight.boundary else ():
        for piece in convex_pieces(pocket, closed=False):
            yield BOUNDARY, piece, (-math.inf, math.inf)
    for zone in flight.no_fly:
        low = -math.inf if zone.lower_m is None or zone.lower_m <= flight.lower_m[2] else zone.lower_m
        high = math.inf if zone.upper_m is None or zone.upper_m >= flight.upper_m[2] else zone.upper_m
        for piece in convex_pieces(zone.polygon):
            yield zone.name, piece, (low, high)


def outlines(flight: Flight) -> Floats:
    """Edges (n, 2, 3) of boundary and zones within the box's heights, for pictures."""
    floor, ceiling = flight.lower_m[2], flight.upper_m[2]
    shapes = [(flight.boundary, floor, ceiling)] if flight.boundary else []
    for zone in flight.no_fly:
        low = floor if zone.lower_m is None else max(zone.lower_m, floor)
        high = ceiling if zone.upper_m is None else min(zone.upper_m, ceiling)
        shapes.append((zone.polygon, low, high))
    edges = []
    for ring, low, high in shapes:
        for one, other in pairwise([*ring, ring[0]]):
            edges += [((*one, z), (*other, z)) for z in (low, high)]
            edges.append(((*one, low), (*one, high)))
    return np.array(edges, float).reshape(-1, 2, 3)
