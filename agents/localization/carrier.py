"""A filter that a vehicle's velocity carries from tick to tick, and what the vehicle tells, with the filter's pose."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from agents.localization.pose_filter import PoseFilter, largest_deviation
from agents.vehicles.vehicle import Telemetry
from protocol.geometry import Floats

YAW: Final = 3


class Carrier:
    def __init__(self, tick_s: float, velocity_sd_mps: float, floor_m: float, floor_rad: float) -> None:
        """``velocity_sd_mps``: of the slow error of the vehicle's velocity; ``floor_m`` and ``floor_rad``: what no
        position and no yaw is better than, whatever the filter says."""
        self._tick_s, self._velocity_sd = tick_s, velocity_sd_mps
        self._floor_m, self._floor_rad = floor_m, floor_rad
        self.filter: PoseFilter | None = None
        """None before the first tick."""
        self.velocity: Floats = np.zeros(4)
        """The vehicle's newest: x, y, z and yaw rate."""

    def carry(self, tick: int, telemetry: Telemetry, deviation_m: float, deviation_rad: float) -> PoseFilter:
        """To ``tick``, with the mean of the last velocity and this one; the deviations are those of a pose to begin
        with, the vehicle's."""
        velocity = telemetry.velocity[:4]
        if self.filter is None:
            self.filter = PoseFilter(tick, telemetry.pose[:4], deviation_m, deviation_rad, self._velocity_sd)
        elif tick > self.filter.tick:
            elapsed_s = (tick - self.filter.tick) * self._tick_s
            self.filter.advance(tick, (velocity + self.velocity) / 2, elapsed_s)
        self.velocity = velocity.copy()
        return self.filter

    def deviation_m(self, located: PoseFilter) -> float:
        """Of the position, along the direction in which it is largest."""
        return float((largest_deviation(located.covariance[:3, :3]) ** 2 + self._floor_m**2) ** 0.5)

    def fused(self, telemetry: Telemetry, located: PoseFilter) -> Telemetry:
        """``telemetry`` with the filter's pose, deviations, and velocity less its error."""
        pose, velocity, rotation = telemetry.pose.copy(), telemetry.velocity.copy(), telemetry.rotation
        pose[:4] = located.pose
        velocity[:3] -= located.velocity_error
        if rotation is not None:
            rotation = _turned(rotation, float(pose[YAW] - telemetry.pose[YAW]))
        return replace(
            telemetry,
            pose=pose,
            velocity=velocity,
            rotation=rotation,
            position_sd_m=self.deviation_m(located),
            angle_sd_rad=float((located.covariance[YAW, YAW] + self._floor_rad**2) ** 0.5),
        )


def _turned(rotation: Floats, angle_rad: float) -> Floats:
    """(3, 3), about the vertical."""
    cosine, sine = math.cos(angle_rad), math.sin(angle_rad)
    turned: Floats = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]) @ rotation
    return turned
