"""The way around zones that a drone follows home, or down: which leg of it is next, and when to look for another.

A way is looked for when there is none yet, when the place to go is another one, and when the next leg is blocked:
others may have pushed the drone aside. Where there is no way at all the wish stays straight, the strict rows hold the
drone before the zone, and `agents.homing.STUCK_S` ends it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from protocol.geometry import Floats
from protocol.mission import Flight
from protocol.routes import Routes, routes_of

REACHED_M = 0.15
"""Distance at which a drone turns to the leg after next, if nothing is in the way of that."""
AGAIN_TICKS = 20
"""Between two looks for a way while there is none: a look takes milliseconds."""


@dataclass(frozen=True, slots=True)
class Leg:
    end: Floats
    """(3,) where to fly straight."""
    left_m: float
    """Length of the way from here, with the descent at its end ..."""
    down_m: float = 0.0
    """... which is so long."""


class Pathway:
    def __init__(self, flight: Flight) -> None:
        self._routes, self._floor_m = routes_of(flight), flight.lower_m[2]
        self._goal: tuple[float, ...] | None = None
        self._way: list[Floats] = []
        self._wait = 0

    def leg(self, place: Floats, goal: Floats | None, beyond_m: float = 0.0) -> Leg | None:
        """The next leg from ``place`` (3,) to above ``goal`` (2,), or to where one may come down; None where that lies
        straight ahead, or where there is no way. ``beyond_m``: how much farther from zones the drone keeps now than
        ways do: it passes their corners at that distance, and so turns earlier.

        Straight ahead is: nothing is in the way to above the goal, nor from there down.
        """
        routes = self._routes
        if routes is None:
            return None
        if _is_straight(routes, place, goal):
            self.forget()
            return None
        wanted = None if goal is None else tuple(goal.tolist())
        if wanted != self._goal:
            self.forget()
        self._goal = wanted
        while len(self._way) > 1 and self._is_passed(routes, place, beyond_m):
            del self._way[0]
        if not self._way or not _may_fly(routes, place, self._way[0]):
            self._look(routes, place, goal)
        if not self._way:
            return None
        left = sum(math.dist(one, other) for one, other in pairwise([place, *self._way]))
        down = float(self._way[-1][2]) - self._floor_m
        return Leg(self._way[0], left + down, down)

    def forget(self) -> None:
        """What comes next is another way."""
        self._way, self._wait = [], 0

    def _look(self, routes: Routes, place: Floats, goal: Floats | None) -> None:
        self._wait -= 1
        if self._wait <= 0:
            self._way = routes.way(place, goal) or []
            self._wait = 0 if self._way else AGAIN_TICKS

    def _is_passed(self, routes: Routes, place: Floats, beyond_m: float) -> bool:
        first, second = self._way[:2]
        return math.dist(place, first) < REACHED_M + beyond_m and _may_fly(routes, place, second)


def _is_straight(routes: Routes, place: Floats, goal: Floats | None) -> bool:
    if goal is None:
        return routes.may_descend(place)
    above = np.array([*goal, place[2]])
    return routes.is_clear(place, above) and routes.may_descend(above)


def _may_fly(routes: Routes, place: Floats, end: Floats) -> bool:
    """Of a vertical leg, which begins where the one before ended, the strict rows know enough."""
    return math.dist(place[:2], end[:2]) < REACHED_M or routes.is_clear(place, end)
