"""Ways around zones: home, or to the nearest place where a drone can come down.

A visibility graph. Its nodes are the corners of every prism, rounded off at the distance that is kept, at every level
of height: a level is a range of heights through which the same prisms are in the way. Level legs lead where nothing is
in the way, vertical ones from level to level. A shortest way goes by such corners, so where there is a way of this
kind it is found. Everything but the start and the goal of a question is looked at once, before take-off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from protocol.airspace import Airspace, airspace_of
from protocol.geometry import Floats
from protocol.prisms import Flags, clear_pairs, flat_distances, is_clear

if TYPE_CHECKING:
    from protocol.mission import Flight

SPARE_M = 0.02
"""Legs keep so much more than D: a strict row lets a drone come nearer only exponentially, so on the line itself it
would crawl."""
CORNER_STEP_RAD = math.pi / 4
"""A rounded corner is a few straight legs, each turning by at most so much."""
_ROUNDING_M = 1e-9
_LEAST_M = 1e-6
"""A leg of no length would be no edge of a sparse graph."""


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    low_m: float
    high_m: float
    active: Flags
    """(n,) prisms in the way there."""
    free: Flags
    """(corners,) nodes that may be flown to."""

    @property
    def middle_m(self) -> float:
        return (self.low_m + self.high_m) / 2


class Routes:
    """Of one mission's zones."""

    def __init__(self, airspace: Airspace, lower_m: Floats, upper_m: Floats) -> None:
        """``lower_m``, ``upper_m`` (3,): of the flight box."""
        self._airspace = airspace
        self._needed = np.full(len(airspace.names), airspace.wide_m + SPARE_M / 2)
        corners = _rounded_corners(airspace, airspace.wide_m + SPARE_M)
        within = (corners >= lower_m[:2]).all(axis=1) & (corners <= upper_m[:2]).all(axis=1)
        sides = (airspace.sides[:, 2] - corners @ airspace.sides[:, :2].T).min(axis=1, initial=math.inf) >= 0
        self._corners = np.ascontiguousarray(corners[within & sides])
        flat = np.array([self._flat(corner) for corner in self._corners]).reshape(-1, len(airspace.names))
        self.levels = []
        edges = []
        count = len(self._corners)
        for number, (low, high) in enumerate(pairwise(airspace.levels(SPARE_M / 2))):
            active = airspace.active((low + high) / 2, SPARE_M / 2)
            free: Flags = np.logical_not(((flat < self._needed) & active).any(axis=1))
            self.levels.append(Level(low, high, active, free))
            pairs = clear_pairs(self._corners, free, self._needed, active, airspace.firsts, airspace.corners)
            one, other = np.nonzero(pairs)
            lengths = np.linalg.norm(self._corners[one] - self._corners[other], axis=1)
            edges.append(np.column_stack([one + number * count, other + number * count, lengths]))
        for number, (below, above) in enumerate(pairwise(self.levels)):
            both = np.flatnonzero(below.free & above.free)
            climb = np.full(len(both), above.middle_m - below.middle_m)
            edges.append(np.column_stack([both + number * count, both + (number + 1) * count, climb]))
        self._edges = np.concatenate(edges)

    def way(self, start: Floats, goal: Floats | None) -> list[Floats] | None:
        """Places (3,) to fly to one after another from ``start`` (3,), the last in the lowest level: above ``goal``
        (2,), or the nearest place where there is a way down. None if there is no way."""
        ends = [start[:2]] if goal is None else [start[:2], goal]
        points = np.vstack([self._corners, *ends])
        count, first = len(points), len(self._corners)
        node = np.arange(first)
        edges = []
        for number, level in enumerate(self.levels):
            known = self._edges[self._level_of(self._edges[:, 0]) == number]
            edges.append(self._renumbered(known, count))
            for k, end in enumerate(ends, start=first):
                flat = self._flat(end)
                if not self._may_be(flat, level):
                    continue
                needed = np.minimum(self._needed, flat)
                seen = [
                    *node[level.free],
                    *([first] if k > first and self._may_be(self._flat(start[:2]), level) else []),
                ]
                for other in seen:
                    least = needed if other < first else np.minimum(needed, self._flat(points[other]))
                    if self._sees(points[other], end, least, level):
                        length = max(_LEAST_M, math.dist(points[other], end))
                        edges.append(np.array([[other + number * count, k + number * count, length]]))
                if number + 1 < len(self.levels) and self._may_be(flat, self.levels[number + 1]):
                    climb = self.levels[number + 1].middle_m - level.middle_m
                    edges.append(np.array([[k + number * count, k + (number + 1) * count, climb]]))
        return self._shortest(start, points, np.concatenate(edges), None if goal is None else count - 1)

    def is_clear(self, start: Floats, end: Floats) -> bool:
        """Whether the straight level way from ``start`` (3,) to above or below ``end`` may be flown at this height."""
        level = self._level_at(start)
        if level is None:
            return False
        needed = np.minimum(self._needed, np.minimum(self._flat(start[:2]), self._flat(end[:2])))
        return self._may_be(self._flat(end[:2]), self.levels[level]) and self._sees(
            start[:2], end[:2], needed, self.levels[level]
        )

    def may_descend(self, place: Floats) -> bool:
        """Whether nothing is in the way straight down from ``place`` (3,)."""
        level = self._level_at(place)
        flat = self._flat(place[:2])
        return level is not None and all(self._may_be(flat, below) for below in self.levels[: level + 1])

    def _shortest(self, start: Floats, points: Floats, edges: Floats, goal: int | None) -> list[Floats] | None:
        level, count = self._level_at(start), len(points)
        if level is None:
            return None
        size = count * len(self.levels)
        ends = edges[:, :2].astype(np.int64)
        graph = coo_array((edges[:, 2], (ends[:, 0], ends[:, 1])), shape=(size, size)).tocsr()
        source = level * count + len(self._corners)
        lengths, before = dijkstra(graph, directed=False, indices=[source], return_predecessors=True)
        lengths, before = lengths[0], before[0]
        target = int(np.argmin(lengths[:count])) if goal is None else goal
        if not np.isfinite(lengths[target]):
            return None
        nodes = [target]
        while nodes[-1] != source:
            nodes.append(int(before[nodes[-1]]))
        way, height = [], float(start[2])
        for place in nodes[-2::-1]:
            through = self.levels[place // count]
            # A little inside, for a drone comes near to a height only exponentially.
            spare = min(SPARE_M, (through.high_m - through.low_m) / 2)
            height = min(max(height, through.low_m + spare), through.high_m - spare)
            way.append(np.array([*points[place % count], height]))
        return way or [np.array([*points[target], height])]

    def _level_at(self, place: Floats) -> int | None:
        """The level in which a drone at ``place`` is taken to be: its own, or the next one to which it may move."""
        flat = self._flat(place[:2])
        gaps = [max(level.low_m - place[2], place[2] - level.high_m, 0.0) for level in self.levels]
        for number in np.argsort(gaps, kind="stable"):
            if gaps[number] > SPARE_M and gaps[number] > min(gaps):
                break
            if self._may_be(flat, self.levels[number]):
                return int(number)
        return None

    def _may_be(self, flat: Floats, level: Level) -> bool:
        """Whether a place at these horizontal distances (n,) from the prisms keeps D to those of the level."""
        return not bool((level.active & (flat < self._airspace.wide_m - _ROUNDING_M)).any())

    def _flat(self, place: Floats) -> Floats:
        airspace = self._airspace
        return flat_distances(np.ascontiguousarray(place), airspace.firsts, airspace.corners, airspace.outer)

    def _sees(self, one: Floats, other: Floats, needed: Floats, level: Level) -> bool:
        airspace = self._airspace
        return is_clear(one, other, needed - _ROUNDING_M, level.active, airspace.firsts, airspace.corners)

    def _level_of(self, nodes: Floats) -> Floats:
        return nodes // max(1, len(self._corners))

    def _renumbered(self, edges: Floats, count: int) -> Floats:
        """The same edges with room for the ends of a question in every level."""
        own = max(1, len(self._corners))
        moved = edges.copy()
        moved[:, :2] += (edges[:, :2] // own) * (count - own)
        return moved


@lru_cache(maxsize=64)
def routes_of(flight: Flight) -> Routes | None:
    """None where there are no zones: every way is straight then, also within a boundary that is convex."""
    airspace = airspace_of(flight)
    if not airspace.names:
        return None
    return Routes(airspace, np.array(flight.lower_m), np.array(flight.upper_m))


def _rounded_corners(airspace: Airspace, keep_m: float) -> Floats:
    """(corners, 2) of polygons around the prisms, no nearer to them than ``keep_m``."""
    found = []
    for first, behind in pairwise(airspace.firsts):
        ring = airspace.corners[first:behind]
        edges = np.roll(ring, -1, axis=0) - ring
        away = np.arctan2(-edges[:, 0], edges[:, 1])  # the outward normal's direction
        for k, corner in enumerate(ring):
            turn = (away[k] - away[k - 1]) % (2 * math.pi)
            legs = max(1, math.ceil(turn / CORNER_STEP_RAD))
            step = turn / legs
            reach = keep_m / math.cos(step / 2)
            angles = away[k - 1] + step * (np.arange(legs) + 0.5)
            found.append(corner + reach * np.column_stack([np.cos(angles), np.sin(angles)]))
    return np.concatenate(found) if found else np.empty((0, 2))
