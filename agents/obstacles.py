"""One drone's part of the map of free cells: what it has heard, what the mission vouches for, and the rows of the QP.

A map takes effect at the tick that it names, in lockstep everywhere at the same one. When maps stay away, what is known
stays as it is: nothing becomes free that was not seen.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from agents.obstacle_rows import nearest_distance, obstacle_rows
from protocol.errors import MessageError
from protocol.geometry import Floats
from protocol.messages import FreeCells
from protocol.mission import Mission
from protocol.obstacle_grid import ObstacleGrid, clear_height, kept_distance, period_ticks
from protocol.separation import top_speed

QUEUE = 64
"""Maps that wait for their tick; in lockstep two at the most."""


@dataclass(frozen=True, slots=True, eq=False)
class ObstacleRows:
    normals: Floats
    """(n, 3)."""
    bounds: Floats
    """(n,): normals . u >= bounds, m/s."""
    barriers: Floats
    """(n,) m."""


class Obstacles:
    """Handed to whatever plans (`agents.planners.planner.Planner.heed`), and brought up to date each tick."""

    def __init__(self, mission: Mission) -> None:
        self._mission, self.grid = mission, ObstacleGrid.of(mission)
        flight = mission.flight
        self._period = period_ticks(mission)
        self._gain, self._hold_s = mission.controller.separation_gain_per_s, flight.setpoint_timeout_s
        self._speed = top_speed(flight)
        self._waiting: deque[FreeCells] = deque(maxlen=QUEUE)
        self._heard = 0
        self._joined = -1
        """Tick from which on maps are waited for."""
        self._deviation_m = 0.0
        self.free = self.grid.vouched
        """[x, y, z]; replaced as a whole."""
        self.kept_m = kept_distance(flight)
        """D, from the newest deviation."""
        self.clear_m = clear_height(mission) + self.kept_m
        """At this height nothing is in a drone's way."""
        self.refused = 0
        """Maps of another lattice."""

    def hear(self, message: FreeCells) -> None:
        self._heard = max(self._heard, message.tick)
        self._waiting.append(message)

    def is_ready(self, tick: int) -> bool:
        """Whether the map that takes effect by ``tick`` has come; in lockstep it always comes, but to a drone that
        joins in flight those that were told before."""
        if self._joined < 0:
            self._joined = tick
        due = tick // self._period * self._period
        return due <= self._joined or self._heard >= due

    def advance(self, tick: int, deviation_m: float = 0.0) -> None:
        """Take the newest map that is in effect at ``tick``. ``deviation_m``: of the own position."""
        due = [message for message in self._waiting if message.tick <= tick]
        if due:
            self._waiting = deque((message for message in self._waiting if message.tick > tick), QUEUE)
            try:
                self.free = self.grid.read(due[-1])
            except MessageError:
                self.refused += 1
        if deviation_m != self._deviation_m:
            self._deviation_m = deviation_m
            self.kept_m = kept_distance(self._mission.flight, deviation_m)
            self.clear_m = clear_height(self._mission) + self.kept_m

    def rows(self, predicted: Floats) -> ObstacleRows:
        """At the predicted position (3,)."""
        return ObstacleRows(
            *obstacle_rows(
                predicted,
                self.free,
                self.grid.origin,
                self.grid.cell_m,
                self.kept_m,
                self._speed,
                self._gain,
                self._hold_s,
            )
        )

    def margin(self, place: Floats, reach_m: float) -> float:
        """Distance of ``place`` (3,) from what is not free, less D; inf beyond ``reach_m``."""
        found = nearest_distance(np.asarray(place), self.free, self.grid.origin, self.grid.cell_m, reach_m)
        return found - self.kept_m
