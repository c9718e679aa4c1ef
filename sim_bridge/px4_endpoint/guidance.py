"""What each mode wants the vehicle to do: a velocity and a yaw rate, from the vehicle's own estimate.

All in local north, east, down of the vehicle; position control is proportional, as PX4's outer loop.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from sim_bridge.px4_endpoint.frames import Vector, wrap
from sim_bridge.px4_endpoint.modes import Mode
from sim_bridge.px4_endpoint.parameters import Parameters

HOME_REACHED_M = 0.3
"""Horizontally; nearer, a return comes down. Tighter than NAV_ACC_RAD, with which PX4 slows down only."""
BRAKING_S = 0.3
"""A hold's place lies this far ahead at the present speed."""


@dataclass(frozen=True, slots=True)
class Target:
    """One SET_POSITION_TARGET_LOCAL_NED; None or NaN where it says nothing."""

    position: Vector | None
    velocity: Vector | None
    yaw: float
    yaw_rate: float


@dataclass(frozen=True, slots=True)
class Estimate:
    position: Vector
    velocity: Vector
    yaw: float


class Guidance:
    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self._place: Vector = (0.0, 0.0, 0.0)
        self._yaw = 0.0
        self._return: Literal["climb", "home", "land"] = "climb"
        self.home: Vector = (0.0, 0.0, 0.0)
        self.sticks: Vector | None = None
        """Velocity that a pilot asks for in a mode flown by hand; None: there is no remote control."""
        self.target: Target | None = None
        """Newest offboard setpoint."""
        self.takeoff_to: float | None = None
        """Down coordinate that a take-off climbs to."""

    def enter(self, mode: Mode, here: Estimate) -> None:
        """Call when the mode changes, and at arming."""
        if mode is Mode.HOLD and self.takeoff_to is not None and self.took_off(here):
            here = Estimate((here.position[0], here.position[1], self.takeoff_to), (0.0, 0.0, 0.0), here.yaw)
        p, v = here.position, here.velocity
        self._place = (p[0] + v[0] * BRAKING_S, p[1] + v[1] * BRAKING_S, p[2] + v[2] * BRAKING_S)
        self._yaw = here.yaw
        self._return = "climb"
        self.takeoff_to = None
        if mode is Mode.TAKEOFF:
            self.takeoff_to = min(p[2], self.home[2] - self._parameters["MIS_TAKEOFF_ALT"])
            self._place = (p[0], p[1], self.takeoff_to)

    def shift(self, by: Vector) -> None:
        """The estimate was reset: places move along with it, as PX4's setpoints do."""
        self._place = _plus(self._place, by)
        self.home = _plus(self.home, by)
        if self.takeoff_to is not None:
            self.takeoff_to += by[2]

    def took_off(self, here: Estimate) -> bool:
        return self.takeoff_to is not None and here.position[2] < self.takeoff_to + self._parameters["NAV_MC_ALT_RAD"]

    def command(self, mode: Mode, here: Estimate) -> tuple[Vector, float]:
        """Velocity (north, east, down) and yaw rate, within the MPC_ limits."""
        if mode is Mode.OFFBOARD and self.target is not None:
            return self._obey(self.target, here)
        if mode is Mode.LAND:
            return self._come_down(here), self._turn(here)
        if mode is Mode.RTL:
            return self._go_home(here), self._turn(here)
        if mode.by_hand:
            if self.sticks is None:
                return self._come_down(here), self._turn(here)
            return self._limit(self.sticks), self._turn(here)
        climb = self._parameters["MPC_TKO_SPEED"] if mode is Mode.TAKEOFF else self._parameters["MPC_Z_VEL_MAX_UP"]
        n, e, d = self._towards(self._place, here)
        return (n, e, max(d, -climb)), self._turn(here)

    def _obey(self, target: Target, here: Estimate) -> tuple[Vector, float]:
        velocity = target.velocity or (0.0, 0.0, 0.0)
        if target.position is not None:
            velocity = _plus(velocity, self._towards(target.position, here))
        if math.isfinite(target.yaw):
            self._yaw = target.yaw
            rate = self._turn(here) + (target.yaw_rate if math.isfinite(target.yaw_rate) else 0.0)
        elif math.isfinite(target.yaw_rate):
            self._yaw, rate = here.yaw, target.yaw_rate
        else:
            rate = self._turn(here)
        limit = math.radians(self._parameters["MC_YAWRATE_MAX"])
        return self._limit(velocity), max(-limit, min(limit, rate))

    def _turn(self, here: Estimate) -> float:
        limit = math.radians(self._parameters["MC_YAWRATE_MAX"])
        return max(-limit, min(limit, self._parameters["MC_YAW_P"] * wrap(self._yaw - here.yaw)))

    def _towards(self, place: Vector, here: Estimate) -> Vector:
        p, gain = here.position, self._parameters["MPC_XY_P"]
        vertical = self._parameters["MPC_Z_P"] * (place[2] - p[2])
        return self._limit((gain * (place[0] - p[0]), gain * (place[1] - p[1]), vertical))

    def _come_down(self, here: Estimate) -> Vector:
        n, e, _ = self._towards(self._place, here)
        return (n, e, self._parameters["MPC_LAND_SPEED"])

    def _go_home(self, here: Estimate) -> Vector:
        """Up to a cone around home, level to above it, down; PX4's RTL_TYPE 0 near home."""
        p = here.position
        distance = math.hypot(p[0] - self.home[0], p[1] - self.home[1])
        if self._return == "climb":
            self._return = "home"
            slope = math.tan(math.radians(max(self._parameters["RTL_CONE_ANG"], 1.0)))
            height = min(self._parameters["RTL_RETURN_ALT"], distance / slope)
            self._place = (self.home[0], self.home[1], min(p[2], self.home[2] - height))
        if self._return == "home" and distance < HOME_REACHED_M:
            self._return = "land"
        if self._return == "land":
            return self._come_down(here)
        n, e, d = self._towards(self._place, here)
        if p[2] > self._place[2] + self._parameters["NAV_MC_ALT_RAD"]:
            return (0.0, 0.0, d)
        share = min(1.0, self._parameters["MPC_XY_CRUISE"] / max(math.hypot(n, e), 1e-9))
        return (n * share, e * share, d)

    def _limit(self, velocity: Vector) -> Vector:
        n, e, d = (v if math.isfinite(v) else 0.0 for v in velocity)
        fastest = self._parameters["MPC_XY_VEL_MAX"]
        share = min(1.0, fastest / max(math.hypot(n, e), 1e-9))
        down = max(-self._parameters["MPC_Z_VEL_MAX_UP"], min(self._parameters["MPC_Z_VEL_MAX_DN"], d))
        return (n * share, e * share, down)


def _plus(a: Vector, b: Vector) -> Vector:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])
