"""The rule for a drone that obstacles hold: it climbs to where nothing stands, and begins anew.

Strict rows may hold a drone for ever: its cells pull it down into a corner that is not free, and as it stands still it
photographs nothing by which the corner could become free. Nothing is relaxed for that. A drone that has not moved for
`Obstacles.stuck_s` though it wants to, with a row of an obstacle at its limit, goes the way up (`agents.way_up`). It
does so until it is above `Obstacles.clear_m`, and at most for `CLIMB_S`: then its planner decides again. On the way it
photographs, so it comes back knowing more; and in the meantime others may have seen its cells.
"""

from __future__ import annotations

import logging
import math

import numpy as np

from agents.barriers import OBSTACLE
from agents.obstacles import Obstacles
from agents.planners.planner import Decision
from agents.way_up import WayUp
from protocol.geometry import Floats
from protocol.mission import Mission

MOVED_M = 0.15
"""Who came farther than this from where it was held is not held; a keyframe is taken after 0.12 m."""
CLIMB_S = 20.0
"""Longest climb; from the floor of a room of 2 m at 0.5 m/s it takes 5 s, unless others or obstacles are in the way."""
APPROACH_PER_S = 2.0
"""Wished speed for each metre to the next point of the way."""
_UNMET = -1e-3
"""Slack below which the sampling row is not met, 1/s."""

log = logging.getLogger(__name__)


class Climbing:
    """Of one drone."""

    def __init__(self, mission: Mission, obstacles: Obstacles) -> None:
        self._stuck_s, self._speed = mission.flight.obstacles.stuck_s, mission.flight.speed_max_mps
        self._way = WayUp(obstacles)
        self._place: Floats | None = None
        """Where it is since ..."""
        self._since_s = 0.0
        """... then."""
        self._until_s = -math.inf
        self.count = 0
        """Climbs so far."""

    def wish(self, place: Floats, now_s: float) -> Floats | None:
        """Velocity (5,) while it climbs from ``place`` (3,); None while it does not."""
        if now_s >= self._until_s:
            return None
        ascent = self._way.ascent(place)
        if ascent is None:
            self.put_off()
            return None
        return towards(place, ascent.end, self._speed)

    def look(self, place: Floats, decision: Decision, now_s: float) -> None:
        """Begin to climb if what the planner decided for ``place`` (3,) has been of no use for too long."""
        if self._place is None or math.dist(self._place, place) > MOVED_M:
            self._place, self._since_s = place.copy(), now_s
        elif now_s - self._since_s > self._stuck_s and _is_held(decision) and self._way.ascent(place) is not None:
            log.info("obstacles hold the drone at %s: climbing", np.round(place, 2))
            self._place, self._until_s = None, now_s + CLIMB_S
            self.count += 1

    def put_off(self) -> None:
        """It does something else now."""
        self._place, self._until_s = None, -math.inf


def towards(place: Floats, end: Floats, speed_mps: float) -> Floats:
    """Velocity (5,) from ``place`` straight to ``end`` (3,), slower near it."""
    offset = end - place
    distance = float(np.linalg.norm(offset))
    wish = np.zeros(5)
    if distance > 0:
        wish[:3] = offset / distance * min(speed_mps, APPROACH_PER_S * distance)
    return wish


def _is_held(decision: Decision) -> bool:
    """Whether an obstacle's row keeps it from what it is to do; so does a program that has no answer beside one."""
    if decision.outcome != "solved":
        return bool(decision.rows.of(OBSTACLE))
    return decision.slack < _UNMET and any(name.startswith(OBSTACLE) for name in decision.active)
