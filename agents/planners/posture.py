"""What the baselines keep while they fly: one height, and for most a camera that looks straight down."""

from __future__ import annotations

import math

import numpy as np

from protocol.geometry import Floats
from protocol.mission import Mission
from protocol.planner_settings import DOWN_RAD

CLOSING_PER_S = 1.5
"""Wished speed for each metre or radian that is left; times the vehicle's lag below 1/4 it does not overshoot."""
TURNED_RAD = 0.05
"""A camera so near to where it should look has been turned there; the gimbal's strict row lets it come closer only
exponentially."""
_YAW, _PITCH = 3, 4


class Posture:
    def __init__(self, mission: Mission) -> None:
        self._altitude_m = mission.planners.altitude_m
        self._down_rad = min(DOWN_RAD, mission.flight.pitch_limits_rad[1])
        self._limits = np.array(mission.flight.velocity_limits)

    def level(self, pose: Floats) -> Floats:
        """Velocity (5,) towards the height that is kept; nothing else moves."""
        return self._towards(np.array([0.0, 0.0, self._altitude_m - pose[2], 0.0, 0.0]))

    def downward(self, pose: Floats, along_rad: float | None = None) -> Floats:
        """Velocity (5,) towards that height with the camera straight down. ``along_rad``: the heading, or its
        opposite, that the image's height is to lie along; None: as it is."""
        gap = np.array([0.0, 0.0, self._altitude_m - pose[2], 0.0, self._down_rad - pose[_PITCH]])
        if along_rad is not None:
            gap[_YAW] = (along_rad - pose[_YAW] + math.pi / 2) % math.pi - math.pi / 2
        return self._towards(gap)

    def is_turned(self, wish: Floats) -> bool:
        """Whether the camera, which is to turn by ``wish`` (5,), is where it should be: images of another view are of
        no use to the method."""
        return bool(np.abs(wish[_YAW:]).max() < CLOSING_PER_S * TURNED_RAD)

    def _towards(self, gap: Floats) -> Floats:
        return np.clip(CLOSING_PER_S * gap, -self._limits, self._limits)
