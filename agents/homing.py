"""Home, and down: where a drone wants to go when it no longer covers. Wishes only: the strict rows decide.

Four rules keep wishes from ending in a stalemate, which strict rows alone would hold for ever: who meets somebody on
the way keeps to the right, nobody comes down above another, around zones one goes by their corners, as
`agents.pathway` says, and out of a room with obstacles up to where nothing stands, as `agents.way_up` does.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence

import numpy as np

from agents.barriers import Neighbour
from agents.climbing import towards
from agents.obstacles import Obstacles
from agents.pathway import Pathway
from agents.planners.planner import Decision, Planner
from agents.way_up import WayUp
from protocol.geometry import Floats
from protocol.mission import Mission
from protocol.separation import error_beyond

ARRIVED_M = 0.2
"""Horizontal distance from home at which it is reached."""
DESCENT_MPS = 0.3
ROOM = 1.5
"""Horizontal distance, in separations, within which somebody is in the way."""
APPROACH_PER_S = 0.8
"""Wished speed for each metre that is left."""
TOUCHDOWN_M = 0.1
"""Height above the flight region's floor from which the vehicle lands by itself."""
STUCK_S = 10.0
"""Who has come no nearer to home, or to the ground, for so long lands by the vehicle's own means where nobody is below:
it cannot hover for ever. Others may stand where its home is, or be silent and so seem to be everywhere."""
NEARER_M = 0.05
"""Less is no progress."""

log = logging.getLogger(__name__)


class Homecoming:
    """Brings one drone down, at home or where it is, and notices when there is no way."""

    def __init__(self, mission: Mission, drone: int, planner: Planner, obstacles: Obstacles | None = None) -> None:
        """``obstacles``: those that the planner heeds."""
        self._flight, self._home, self._planner = mission.flight, mission.drone(drone).start, planner
        self._pathway = Pathway(mission.flight)
        self._way_up = None if obstacles is None else WayUp(obstacles)
        self._left_m = math.inf
        """Way to go, the least so far ..."""
        self._nearer_s = 0.0
        """... and since when."""
        self.landing = False
        """Whether the vehicle is to land by itself now; it is never taken back."""

    def steer(
        self,
        pose: Floats,
        velocity: Floats,
        neighbours: Sequence[Neighbour],
        *,
        home: bool,
        now_s: float,
        deviation_m: float = 0.0,
    ) -> Decision:
        """``pose`` and ``velocity`` (5,); ``home``: at the start's place instead of here; ``deviation_m``: of the
        pose's position, which keeps a drone so much farther from zones and from the floor."""
        beyond_m = error_beyond(self._flight, deviation_m)
        distance, speed = self._flight.estimated_separation_m, self._flight.speed_max_mps
        away_m = math.dist(pose[:2], self._home[:2]) if home else 0.0
        ascent = self._way_up.ascent(pose[:3]) if self._way_up is not None and away_m > ARRIVED_M else None
        leg = None
        if ascent is None:
            leg = self._pathway.leg(pose[:3], np.array(self._home[:2]) if home else None, beyond_m)
        if ascent is not None:
            wish = towards(pose[:3], ascent.end, speed)
        elif leg is not None:
            wish = leg_wish(pose, leg.end, neighbours, distance, speed)
        elif home:
            wish = home_wish(pose, self._home, neighbours, distance, speed)
        else:
            wish = down_wish(pose, neighbours, distance, speed)
        decision = self._planner.steer(pose, velocity, neighbours, wish)
        height = float(pose[2]) - self._flight.lower_m[2]
        down = ascent is None and leg is None
        self.landing = self.landing or bool(down and height < TOUCHDOWN_M + beyond_m and wish[2] < 0)
        left_m = height + away_m
        if leg is not None:
            left_m = leg.left_m
        elif ascent is not None:
            left_m = 2 * ascent.left_m + left_m
        if left_m < self._left_m - NEARER_M:
            self._left_m, self._nearer_s = left_m, now_s
        elif now_s - self._nearer_s > STUCK_S and not self.landing and not _below(pose, neighbours, distance):
            log.warning("no way %s for %g s: landing here", "home" if home else "down", STUCK_S)
            self.landing = True
        return decision

    def put_off(self) -> None:
        """It does something else now."""
        self._left_m = math.inf
        self._pathway.forget()


def home_wish(
    pose: Floats, home: Sequence[float], neighbours: Sequence[Neighbour], separation_m: float, speed_mps: float
) -> Floats:
    """Velocity (5,) towards ``home`` (x, y) at the present height; `down_wish` once it is reached."""
    if math.dist(home[:2], pose[:2]) < ARRIVED_M:
        return down_wish(pose, neighbours, separation_m, speed_mps)
    return _level_wish(pose, np.asarray(home[:2], float), neighbours, separation_m, speed_mps)


def leg_wish(
    pose: Floats, end: Floats, neighbours: Sequence[Neighbour], separation_m: float, speed_mps: float
) -> Floats:
    """Velocity (5,) along a leg to ``end`` (3,): to its height and to its place at once, for the leg is level or
    vertical, but for what the drone is off it."""
    wish = np.zeros(5)
    if math.dist(end[:2], pose[:2]) > 0:
        wish = _level_wish(pose, end[:2], neighbours, separation_m, speed_mps)
    climb = APPROACH_PER_S * float(end[2] - pose[2])
    wish[2] = min(max(climb, -min(DESCENT_MPS, speed_mps)), speed_mps)
    return wish


def _level_wish(
    pose: Floats, place: Floats, neighbours: Sequence[Neighbour], separation_m: float, speed_mps: float
) -> Floats:
    """Velocity (5,) towards ``place`` (2,), keeping to the right of others."""
    offset = place - pose[:2]
    distance = float(np.linalg.norm(offset))
    heading = offset / distance
    if _meets(pose, heading, neighbours, separation_m):
        heading = (heading + np.array([heading[1], -heading[0]])) / math.sqrt(2)  # 45 degrees to the right
    wish = np.zeros(5)
    wish[:2] = heading * min(speed_mps, APPROACH_PER_S * distance)
    return wish


def down_wish(pose: Floats, neighbours: Sequence[Neighbour], separation_m: float, speed_mps: float) -> Floats:
    """Velocity (5,) straight down; sideways instead while somebody is below or near it."""
    away = np.zeros(2)
    for neighbour in _below(pose, neighbours, separation_m):
        offset = pose[:2] - neighbour.position[:2]
        distance = float(np.linalg.norm(offset))
        # Exactly above each other every direction is as good; the number makes two of them choose different ones.
        direction = offset / distance if distance > 1e-6 else _direction(neighbour.drone)
        away += direction * (1 - distance / separation_m + 0.2)
    wish = np.zeros(5)
    strength = float(np.linalg.norm(away))
    if strength > 0:
        wish[:2] = away / strength * min(speed_mps, strength)
    else:
        wish[2] = -min(DESCENT_MPS, speed_mps)
    return wish


def _below(pose: Floats, neighbours: Sequence[Neighbour], separation_m: float) -> list[Neighbour]:
    """Those on whom it would come down."""
    return [
        neighbour
        for neighbour in neighbours
        if neighbour.position[2] < pose[2] and math.dist(neighbour.position[:2], pose[:2]) < separation_m
    ]


def _meets(pose: Floats, heading: Floats, neighbours: Sequence[Neighbour], separation_m: float) -> bool:
    offsets = [neighbour.position - pose[:3] for neighbour in neighbours]
    return any(np.linalg.norm(offset) < ROOM * separation_m and heading @ offset[:2] > 0 for offset in offsets)


def _direction(number: int) -> Floats:
    return np.array([math.cos(number), math.sin(number)])
