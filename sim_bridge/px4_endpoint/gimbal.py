"""A two-axis gimbal and its manager (gimbal protocol v2), as PX4 is one for a gimbal it drives itself.

Pitch is positive upwards; yaw clockwise, from the vehicle's nose, or from north when locked. Radians.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from sim_bridge.px4_endpoint.body import follow
from sim_bridge.px4_endpoint.dialect import mavlink
from sim_bridge.px4_endpoint.frames import wrap
from sim_bridge.px4_endpoint.parameters import Parameters

DEVICE = 1
"""Its device id: one of 1 to 6, for it shares the autopilot's component id."""
GAIN_PER_S = 20.0
"""Of the angle error into a rate, up to the largest one."""
LAG_S = 0.02
ACCELERATION_MAX_RADPS2 = 40.0

ID_MAX = 255
KEEP, SELF, RELEASE = -1, -2, -3
"""Special system and component ids of DO_GIMBAL_MANAGER_CONFIGURE."""


@dataclass(slots=True)
class Axis:
    angle: float
    rate: float = 0.0

    def slew(self, error: float, feed_forward: float, fastest: float, dt: float) -> None:
        wanted = max(-fastest, min(fastest, GAIN_PER_S * error + feed_forward))
        way, self.rate = follow(self.rate, wanted, LAG_S, ACCELERATION_MAX_RADPS2, dt)
        self.angle += way


class Gimbal:
    def __init__(self, parameters: Parameters, rate_max_radps: float) -> None:
        self._parameters = parameters
        self._fastest = rate_max_radps
        self.pitch = Axis(0.0)
        self.yaw = Axis(0.0)
        """From the vehicle's nose."""
        self.controller = (0, 0)
        """System and component id of who has primary control; zeros: nobody."""
        self.locked = False
        self.stuck = False
        self.silent = False
        self._wanted_pitch = 0.0
        self._wanted_yaw = 0.0
        self._rates = (0.0, 0.0)

    def release(self) -> None:
        """Its manager begins anew: nobody has control."""
        self.controller, self.locked, self._rates = (0, 0), False, (0.0, 0.0)

    def configure(self, primary: tuple[float, float], source: tuple[int, int]) -> None:
        """DO_GIMBAL_MANAGER_CONFIGURE: hand out primary control."""
        system, component = (round(value) if math.isfinite(value) else KEEP for value in primary)
        if system == SELF:
            self.controller = source
        elif system == RELEASE:
            self.controller = (0, 0) if self.controller == source else self.controller
        elif 0 <= system <= ID_MAX:
            self.controller = (system, min(max(component, 0), ID_MAX))

    def aim(
        self, source: tuple[int, int], flags: int, pitch: float, yaw: float, pitch_rate: float, yaw_rate: float
    ) -> bool:
        """New setpoint; NaN where an angle or a rate is not asked for. False: ``source`` is not in control."""
        if source != self.controller:
            return False
        locked = bool(flags & mavlink.GIMBAL_MANAGER_FLAGS_YAW_LOCK)
        if locked != self.locked:
            self._wanted_yaw = wrap(self._wanted_yaw)
        self.locked = locked
        if math.isfinite(pitch):
            self._wanted_pitch = pitch
        if math.isfinite(yaw):
            self._wanted_yaw = yaw
        self._rates = (pitch_rate if math.isfinite(pitch_rate) else 0.0, yaw_rate if math.isfinite(yaw_rate) else 0.0)
        return True

    def step(self, vehicle_yaw: float, dt: float) -> None:
        if self.stuck:
            self.pitch.rate = self.yaw.rate = 0.0
            return
        reach = math.radians(self._parameters["MNT_RANGE_PITCH"]) / 2
        self._wanted_pitch = max(-reach, min(reach, self._wanted_pitch + self._rates[0] * dt))
        self._wanted_yaw = wrap(self._wanted_yaw + self._rates[1] * dt)
        self.pitch.slew(self._wanted_pitch - self.pitch.angle, self._rates[0], self._fastest, dt)
        ahead = wrap(self._wanted_yaw - vehicle_yaw) if self.locked else self._wanted_yaw
        reach = math.radians(self._parameters["MNT_RANGE_YAW"]) / 2
        error = max(-reach, min(reach, ahead)) - self.yaw.angle
        self.yaw.slew(error if reach < math.pi else wrap(error), self._rates[1], self._fastest, dt)
        self.yaw.angle = wrap(self.yaw.angle)

    @property
    def flags(self) -> int:
        """GIMBAL_DEVICE_FLAGS: its angles are given from the vehicle's nose."""
        lock: int = mavlink.GIMBAL_DEVICE_FLAGS_ROLL_LOCK | mavlink.GIMBAL_DEVICE_FLAGS_PITCH_LOCK
        lock |= mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME
        return lock | (mavlink.GIMBAL_DEVICE_FLAGS_YAW_LOCK if self.locked else 0)
