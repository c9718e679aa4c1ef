"""How the airframe moves: commanded velocities with lag and limited acceleration, and what the wind does to them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from protocol.mission import Flight
from protocol.vehicle_settings import Autopilot
from sim_bridge.px4_endpoint.frames import Vector, wrap

GRAVITY_MPS2 = 9.81
DRAG_PER_S = 0.25
"""Deceleration per speed through the air; quadrotors of 1 to 2 kg have 0.1 to 0.5."""
TILT_S = 0.08
"""Lag of roll and pitch."""
GUST_MEMORY_S = 1.0


class Wind:
    """A mean and gusts; ``gust`` and ``mean`` are towards north and east, m/s."""

    def __init__(self, settings: Autopilot, dice: np.random.Generator) -> None:
        self.mean = (settings.wind_mps[1], settings.wind_mps[0])
        self.gust = (0.0, 0.0)
        self._deviation = settings.gust_mps
        self._dice = dice

    def step(self, dt: float) -> None:
        """Ornstein-Uhlenbeck process, exact for any ``dt``."""
        if self._deviation == 0:
            return
        keep = math.exp(-dt / GUST_MEMORY_S)
        fresh = self._deviation * math.sqrt(1 - keep * keep)
        north, east = self._dice.standard_normal(2).tolist()
        self.gust = (self.gust[0] * keep + fresh * north, self.gust[1] * keep + fresh * east)


@dataclass(slots=True)
class Body:
    """The true state: north, east, down of the world's origin in metres, yaw clockwise from north, radians."""

    position: Vector
    yaw: float
    velocity: Vector = (0.0, 0.0, 0.0)
    yaw_rate: float = 0.0
    roll: float = 0.0
    pitch: float = 0.0
    push: Vector = field(default=(0.0, 0.0, 0.0))
    """Velocity that comes on top of what is flown: something carries the vehicle away."""

    @property
    def on_ground(self) -> bool:
        return self.position[2] >= 0

    def fly(self, wanted: Vector, yaw_rate: float, wind: Wind, flight: Flight, dt: float) -> None:
        """``dt`` seconds towards the velocity ``wanted`` and ``yaw_rate``.

        The mean wind is flown out by leaning into it, as an autopilot's integrator does; gusts are not.
        """
        tau, limit = flight.response_time_s, flight.acceleration_max_mps2
        moved = [follow(v, w, tau, limit, dt) for v, w in zip(self.velocity, wanted, strict=True)]
        speeds = [speed for _, speed in moved]
        speeds[0] += DRAG_PER_S * wind.gust[0] * dt
        speeds[1] += DRAG_PER_S * wind.gust[1] * dt
        self._lean(speeds, wind, dt)
        turned, self.yaw_rate = follow(self.yaw_rate, yaw_rate, tau, flight.angular_acceleration_max_radps2, dt)
        self.yaw = wrap(self.yaw + turned)
        self._move([way for way, _ in moved], speeds, dt)

    def rest(self, dt: float) -> None:
        """``dt`` seconds without thrust: stand on the ground, or fall to it."""
        n, e, d = self.velocity
        self.yaw_rate = self.roll = self.pitch = 0.0
        if self.on_ground:
            n = e = 0.0
        self._move([n * dt, e * dt, d * dt], [n, e, d + GRAVITY_MPS2 * dt], dt)

    def _move(self, way: list[float], speeds: list[float], dt: float) -> None:
        n, e, d = (p + w + extra * dt for p, w, extra in zip(self.position, way, self.push, strict=True))
        if d >= 0:
            d, speeds = 0.0, [0.0, 0.0, min(speeds[2], 0.0)]
        self.position, self.velocity = (n, e, d), (speeds[0], speeds[1], speeds[2])

    def _lean(self, speeds: list[float], wind: Wind, dt: float) -> None:
        force = [
            (speeds[i] - self.velocity[i]) / dt + DRAG_PER_S * (speeds[i] - wind.mean[i] - wind.gust[i]) for i in (0, 1)
        ]
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        share = -math.expm1(-dt / TILT_S)
        self.pitch += share * (math.atan2(-(c * force[0] + s * force[1]), GRAVITY_MPS2) - self.pitch)
        self.roll += share * (math.atan2(-s * force[0] + c * force[1], GRAVITY_MPS2) - self.roll)


def follow(speed: float, wanted: float, tau: float, limit: float, dt: float) -> tuple[float, float]:
    """Way covered in ``dt``, and speed after it: ``dv/dt = clip((wanted - v) / tau, +-limit)``, exact if unclipped."""
    gap = wanted - speed
    approach = 1.0 if tau == 0 else -math.expm1(-dt / tau)
    if abs(gap) > limit * max(tau, dt):  # the whole step at full acceleration
        change = math.copysign(min(limit * dt, abs(gap * approach)), gap)
        return speed * dt + change * dt / 2, speed + change
    return wanted * dt - gap * tau * approach, speed + gap * approach
