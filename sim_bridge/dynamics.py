"""How a simulated vehicle and its gimbal follow commanded velocities: first-order lag with limited acceleration."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from protocol.geometry import Floats
from protocol.mission import Flight


@dataclass(slots=True)
class VehicleBody:
    """State of one vehicle; ``pose`` and ``velocity`` are (5,): x, y, z, camera yaw and pitch, and their rates."""

    pose: Floats
    velocity: Floats
    commanded: Floats
    commanded_at_s: float

    @classmethod
    def at(cls, start: Floats) -> VehicleBody:
        return cls(np.array(start, float), np.zeros(5), np.zeros(5), 0.0)

    def command(self, velocity: Floats, now_s: float, flight: Flight) -> None:
        """Accept a setpoint, clipped to what the vehicle can fly."""
        limit = np.array([flight.speed_max_mps] * 3 + [flight.turn_rate_max_radps] * 2)
        self.commanded = np.clip(velocity, -limit, limit)
        self.commanded_at_s = now_s

    def step(self, dt: float, now_s: float, flight: Flight) -> None:
        """Advance by ``dt`` seconds: ``dv/dt = clip((u - v) / tau, +-a)`` on each axis, exact while unclipped.

        Setpoints older than the time-out are replaced by zero velocity, as an autopilot does (safety rule 2).
        """
        if now_s - self.commanded_at_s > flight.setpoint_timeout_s:
            self.commanded = np.zeros(5)
        tau = flight.response_time_s
        limit = np.array([flight.acceleration_max_mps2] * 3 + [flight.angular_acceleration_max_radps2] * 2)
        wanted = self.commanded - self.velocity
        if tau > 0:
            change = wanted * -math.expm1(-dt / tau)
            # Mean velocity over the step of an exponential approach, from its integral.
            travelled = self.commanded * dt - wanted * tau * -math.expm1(-dt / tau)
        else:
            change, travelled = wanted, self.commanded * dt
        clipped = np.clip(change, -limit * dt, limit * dt)
        straight = self.velocity * dt + clipped * dt / 2
        saturated = np.abs(wanted) > limit * max(tau, dt)
        self.pose = self.pose + np.where(saturated, straight, travelled)
        self.velocity = self.velocity + np.where(saturated, clipped, change)
        self.pose[3] = math.remainder(self.pose[3], 2 * math.pi)
