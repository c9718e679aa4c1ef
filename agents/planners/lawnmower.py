"""A preset sweep: strip by strip over the target with the camera straight down, whatever is seen.

Source: M. Torres, D. A. Pelta, J. L. Verdegay, J. C. Torres, "Coverage path planning with unmanned aerial vehicles for
3D terrain reconstruction", Expert Systems with Applications 55 (2016), as Coverage-Recon compares with it. Taken from
it: back and forth at a fixed height in strips along the longer side, which makes the fewest turns; strips as wide as
the camera's footprint, with an overlap; the image's width across the strip. Ours: a rectangle instead of any polygon;
the footprint is that on the plane at D below the drone, which is sensed best and, at the default height, halves the
target; a part of the target for each drone of a team; and what happens next. A drone that is done sweeps its part again
crosswise, then along again: it would have to wait otherwise, and crosswise every place comes to see other sides of what
stands on it. The way is flown through the strict rows of all planners.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

import numpy as np

from agents.barriers import Neighbour
from agents.planners.filtered import FilteredPlanner
from agents.planners.planner import Decision
from agents.planners.posture import CLOSING_PER_S, Posture
from agents.planners.sweep import Footprint, Rectangle, divide, footprint_of, sweep
from agents.quadratic_program import Held
from protocol.geometry import Floats
from protocol.importance import SamplingTerms
from protocol.mission import Mission

ARRIVED_M = 0.05
"""Distance at which a waypoint is passed; the strips leave so much to spare on each side."""
WAIT_S = 5.0
"""A waypoint that comes no nearer for so long is left out: somebody is in the way, or stands there and so sees what is
to be seen from there."""
NEARER_M = 0.05
"""Less is no progress."""
_ALL = np.ones(5, np.bool_)


class Lawnmower(FilteredPlanner):
    def __init__(self, mission: Mission, drone: int, neighbours: int) -> None:
        super().__init__(mission, neighbours)
        self._posture = Posture(mission)
        target, flight = mission.target, mission.flight
        area = Rectangle(target.lower_m[:2], target.upper_m[:2])
        self._sector = divide(area, {other.id: other.start[:2] for other in mission.drones})[drone]
        seen = footprint_of(mission.camera, mission.sensing.distance_m)
        self._footprint = Footprint(_spared(seen.width_m), _spared(seen.length_m))
        self._low, self._high = np.array(flight.lower_m[:2]), np.array(flight.upper_m[:2])
        self._along = self._sector.longer_axis
        self._way: deque[Floats] = deque()
        self._left_m = math.inf
        """To the next waypoint, the least so far ..."""
        self._waited = 0
        """... and decisions since then."""
        self._patience = round(WAIT_S / mission.tick_s)
        self.passes = 0
        """Sweeps that are done."""
        self.left_out = 0
        """Waypoints that could not be reached."""

    def decide(
        self,
        pose: Floats,
        velocity: Floats,
        neighbours: Sequence[Neighbour],
        terms: SamplingTerms,
        cells: float,  # noqa: ARG002  # the way is set before
    ) -> Decision:
        if not self._way:
            self._begin(pose)
        wish = self._posture.downward(pose, self._along * math.pi / 2)
        if self._posture.is_turned(wish):
            wish[:2] = self._towards_next(pose)
        return self._filter.solve(
            pose,
            velocity,
            neighbours,
            np.zeros(5),
            0.0,
            sampling=self._mission.sensing.decay_per_s * terms.first,
            held=Held(_ALL, wish),
        )

    def _begin(self, pose: Floats) -> None:
        """A sweep from the nearest corner; where the drone may not fly, from the nearest place where it may."""
        way = sweep(self._sector, self._along, self._footprint, self._mission.planners.overlap, pose[:2])
        self._way.extend(np.clip(way, self._low, self._high))

    def _towards_next(self, pose: Floats) -> Floats:
        """Horizontal velocity (2,) towards the next waypoint, which is passed or left out where it is time to."""
        left_m = math.hypot(*(self._way[0] - pose[:2]), self._mission.planners.altitude_m - pose[2])
        self._waited += 1
        if left_m < self._left_m - NEARER_M:
            self._left_m, self._waited = left_m, 0
        blocked = self._waited > self._patience
        if left_m < ARRIVED_M or blocked:
            self.left_out += blocked and left_m >= ARRIVED_M
            self._way.popleft()
            self._left_m, self._waited = math.inf, 0
            if not self._way:
                self.passes += 1
                self._along = 1 - self._along
                return np.zeros(2)
        offset = self._way[0] - pose[:2]
        distance = float(np.linalg.norm(offset))
        speed = min(self._mission.flight.speed_max_mps, CLOSING_PER_S * distance)
        towards: Floats = offset * (speed / max(distance, 1e-9))
        return towards


def _spared(side_m: float) -> float:
    """A side of the footprint that is seen also where a waypoint is passed at a distance; half of it if it is tiny."""
    return max(side_m - 2 * ARRIVED_M, side_m / 2)
