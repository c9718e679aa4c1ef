"""How a simulated vehicle and its gimbal follow commanded velocities: first-order lag with limited acceleration."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from protocol.geometry import Floats
from protocol.mission import Flight

DOWN_M = 0.05
"""Height below which a vehicle that lands stands on the ground."""
LANDING_MPS = 0.3
"""Descent of a vehicle that lands, down to z = 0."""


@dataclass(slots=True)
class VehicleBody:
    """State of one vehicle; ``pose`` and ``velocity`` are (5,): x, y, z, camera yaw and pitch, and their rates."""

    pose: Floats
    velocity: Floats
    commanded: Floats
    commanded_at_s: float
    landing: bool = False
    """Whether it comes down or stands on the ground: commands no longer matter."""

    @property
    def is_down(self) -> bool:
        """Whether it stands on the ground, for good."""
        return self.landing and bool(self.pose[2] < DOWN_M)

    @classmethod
    def at(cls, start: Floats) -> VehicleBody:
        return cls(np.array(start, float), np.zeros(5), np.zeros(5), 0.0)

    def command(self, velocity: Floats, now_s: float, flight: Flight) -> None:
        """Accept a setpoint, clipped to what the vehicle can fly."""
        limit = np.array(flight.velocity_limits)
        self.commanded = np.clip(velocity, -limit, limit)
        self.commanded_at_s = now_s

    def step(self, dt: float, now_s: float, flight: Flight) -> None:
        """Advance by ``dt`` seconds: ``dv/dt = clip((u - v) / tau, +-a)`` on each axis, exact while unclipped.

        Setpoints older than the time-out are replaced by zero velocity, as an autopilot does.
        """
        if self.landing:
            rest = self.pose[2] + flight.response_time_s * self.velocity[2]  # where it comes to rest if it brakes now
            self.commanded = np.array([0.0, 0.0, -min(LANDING_MPS, max(rest, 0.0) / dt), 0.0, 0.0])
        elif now_s - self.commanded_at_s > flight.setpoint_timeout_s:
            self.commanded = np.zeros(5)
        self.pose, self.velocity = _follow(
            self.pose, self.velocity, self.commanded, flight.acceleration_limits, flight.response_time_s, dt
        )


@njit(cache=True, nogil=True)
def _follow(
    pose: Floats,
    velocity: Floats,
    commanded: Floats,
    limits: tuple[float, float, float, float, float],
    tau: float,
    dt: float,
) -> tuple[Floats, Floats]:
    """Pose and velocity (5,) after ``dt``; ``limits`` are those of the accelerations."""
    approach = 1.0 if tau == 0 else -math.expm1(-dt / tau)
    new_pose, new_velocity = pose.copy(), velocity.copy()
    for axis in range(5):
        limit = limits[axis]
        wanted = commanded[axis] - velocity[axis]
        if abs(wanted) > limit * max(tau, dt):  # the whole step at full acceleration
            change = math.copysign(min(limit * dt, abs(wanted * approach)), wanted)
            new_pose[axis] += velocity[axis] * dt + change * dt / 2
        else:
            change = wanted * approach
            new_pose[axis] += commanded[axis] * dt - wanted * tau * approach  # integral of the approach
        new_velocity[axis] += change
    new_pose[3] = (new_pose[3] + math.pi) % (2 * math.pi) - math.pi
    return new_pose, new_velocity
