"""When a battery holds just enough for the way home: the share that must be left, from the real way and the use so far.

The use is learned from the fall of the share that the vehicle tells, whatever carries it. PX4 tells whole per cent, and
some batteries stay at 100 % for a while, so it is never taken for less than that of a battery which lasts for
``vehicles.battery_full_s``.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from agents.homing import ARRIVED_M, DESCENT_MPS
from agents.obstacles import Obstacles
from agents.pathway import Pathway
from agents.vehicles.vehicle import Telemetry
from protocol.mission import Flight, Mission

WINDOW_S = 60.0
"""The use is that of so long a flight ..."""
LEARN_S = 10.0
"""... and of no shorter one."""
SAMPLE_S = 0.5
"""Between two samples of the share, and two looks for the way home."""
LAST_METRES_S = 2.0
"""What the way takes beyond full speed: the last half metre to home is flown ever slower, and so is that to the
ground. Measured: 1 to 2 s."""


def landing_s(flight: Flight, height_m: float) -> float:
    """How long it takes from ``height_m`` (world z) straight down, until the motors stop."""
    return max(0.0, height_m) / min(DESCENT_MPS, flight.speed_max_mps) + LAST_METRES_S


class Reserve:
    """Of one drone."""

    def __init__(self, mission: Mission, drone: int, obstacles: Obstacles | None = None) -> None:
        """``obstacles``: a way home leads up to above them, and down from there (`agents.homing`)."""
        self._flight, self._vehicles, self._obstacles = mission.flight, mission.vehicles, obstacles
        self._home = np.array(mission.drone(drone).start)
        self._pathway = Pathway(mission.flight)
        ids = sorted(other.id for other in mission.drones)
        self._rank, self._team = ids.index(drone), len(ids)
        self._samples: deque[tuple[float, float]] = deque()
        self._known_per_s = 1.0 / mission.vehicles.battery_full_s
        self._fresh = True
        """Whether it flies on its first battery."""
        self.share = 0.0
        """The share from which it must return; 0 while it does not fly, or its battery does not empty."""
        self.home_s = 0.0
        """How long the way home and the landing take from here."""

    def look(self, telemetry: Telemetry) -> None:
        """Every tick that the vehicle flies for us."""
        now_s, left = telemetry.stamp_s, telemetry.battery
        if self._samples and now_s - self._samples[-1][0] < SAMPLE_S:
            return
        self._samples.append((now_s, left))
        while now_s - self._samples[0][0] > WINDOW_S:
            self._samples.popleft()
        if left >= 1.0:
            return
        self.home_s = self._home_s(telemetry)
        critical, factor = self._vehicles.battery_critical, self._vehicles.reserve_factor
        needed = critical + factor * self.home_s * self.use_per_s
        self.share = needed + self._stagger(1.0 - needed)

    def land(self) -> None:
        """It stands on the ground: what comes next is another flight, with another battery."""
        if self._samples:
            self._known_per_s, self._fresh = self.use_per_s, False
        self._samples.clear()
        self._pathway.forget()
        self.share = self.home_s = 0.0

    @property
    def use_per_s(self) -> float:
        """Share that each second of flight takes; in the first seconds, what it took with the battery before."""
        if not self._samples:
            return self._known_per_s
        (began_s, before), (now_s, left) = self._samples[0], self._samples[-1]
        if now_s - began_s < LEARN_S:
            return self._known_per_s
        return max(1.0 / self._vehicles.battery_full_s, (before - left) / (now_s - began_s))

    def _home_s(self, telemetry: Telemetry) -> float:
        place, floor_m = telemetry.pose[:3], self._flight.lower_m[2]
        leg = self._pathway.leg(place, self._home[:2])
        away_m, down_m = math.dist(place[:2], self._home[:2]), max(0.0, float(place[2]) - floor_m)
        level_m, climb_m = away_m, 0.0
        if self._obstacles is not None and away_m > ARRIVED_M:
            climb_m = max(0.0, self._obstacles.clear_m - float(place[2]))
        if leg is not None:
            level_m, down_m = leg.left_m - leg.down_m, leg.down_m
        return (level_m + climb_m) / self._flight.speed_max_mps + landing_s(self._flight, floor_m + down_m + climb_m)

    def _stagger(self, usable: float) -> float:
        """What keeps those who took off together from being away together: with their first battery, each goes home
        earlier than the one before, by as long as a swap keeps it away, or by its part of what is ``usable``."""
        if self._vehicles.battery_swap_s == 0 or not self._fresh or self._rank == 0:
            return 0.0
        away = (self._vehicles.battery_swap_s + 2 * self.home_s) * self.use_per_s
        return self._rank * min(away, max(0.0, usable) / self._team)
