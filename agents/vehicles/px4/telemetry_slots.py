"""The newest of everything a vehicle says, with the time at which it came.

MAVSDK calls back on a thread of its own; each callback writes one attribute, and readers of any thread take it. Getters
of MAVSDK are not used: they go on giving the last value when the vehicle has long fallen silent.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from mavsdk import System
from mavsdk.plugins.gimbal import Gimbal
from mavsdk.plugins.telemetry import Telemetry

from agents.vehicles.px4.refusals import refusals
from protocol.geometry import Floats

Value = TypeVar("Value")


@dataclass(frozen=True, slots=True)
class Sample(Generic[Value]):
    value: Value
    at_s: float
    """When it came."""


@dataclass(frozen=True, slots=True)
class Motion:
    """Local NED."""

    position: Floats
    """(3,), metres."""
    velocity: Floats
    """(3,), m/s."""


@dataclass(frozen=True, slots=True)
class Attitude:
    """Of the airframe, 3-2-1 sequence, FRD to NED."""

    roll_rad: float
    pitch_rad: float
    yaw_rad: float


@dataclass(frozen=True, slots=True)
class Pointing:
    """Of the gimbal."""

    pitch_rad: float
    """Positive upwards."""
    yaw_rad: float
    """Clockwise from north."""


@dataclass(frozen=True, slots=True)
class Health:
    gyroscope: bool
    accelerometer: bool
    magnetometer: bool
    local_position: bool
    global_position: bool
    home: bool
    armable: bool


def is_jump(before: Sample[Motion], after: Sample[Motion], speed_mps: float, tolerance_m: float) -> bool:
    """Whether the estimate moved by ``tolerance_m`` more than a vehicle can; ``speed_mps``: more than the commanded
    speed, in case a pilot flies, is what the estimate itself says."""
    fastest = max(speed_mps, float(np.linalg.norm(before.value.velocity)), float(np.linalg.norm(after.value.velocity)))
    moved = float(np.linalg.norm(after.value.position - before.value.position))
    return moved - fastest * (after.at_s - before.at_s) > tolerance_m


class TelemetrySlots:
    def __init__(
        self, now_s: Callable[[], float], texts: Callable[[str, str], None], speed_mps: float, jump_m: float
    ) -> None:
        """``texts``: called on MAVSDK's thread with level and status text."""
        self._now_s, self._texts, self._speed_mps, self._jump_m = now_s, texts, speed_mps, jump_m
        self._unsubscribe: list[Callable[[], None]] = []
        self.motion: Sample[Motion] | None = None
        self.attitude: Sample[Attitude] | None = None
        self.body_rates: Sample[Floats] | None = None
        """(3,): p, q, r in rad/s."""
        self.battery: Sample[float] | None = None
        """Share left, 0 to 1."""
        self.armed: Sample[bool] | None = None
        self.mode: Sample[str] | None = None
        """The name of a `mavsdk.plugins.telemetry.FlightMode`."""
        self.landed: Sample[str] | None = None
        """The name of a `mavsdk.plugins.telemetry.LandedState`."""
        self.health: Sample[Health] | None = None
        self.pointing: Sample[Pointing] | None = None
        self.connected: Sample[bool] | None = None
        self.jumps = 0

    def subscribe(self, system: System, telemetry: Telemetry, gimbal: Gimbal | None) -> None:
        """Raises: VehicleError: the vehicle's connection is gone."""
        self.connected = Sample(True, self._now_s())
        with refusals("subscribing to telemetry"):
            self._keep(system, "is_connected", self._hear_connected)
            self._keep(telemetry, "position_velocity_ned", self._hear_motion)
            self._keep(telemetry, "attitude_euler", self._hear_attitude)
            self._keep(telemetry, "attitude_angular_velocity_body", self._hear_rates)
            self._keep(telemetry, "battery", self._hear_battery)
            self._keep(telemetry, "armed", self._hear_armed)
            self._keep(telemetry, "flight_mode", self._hear_mode)
            self._keep(telemetry, "landed_state", self._hear_landed)
            self._keep(telemetry, "health", self._hear_health)
            self._keep(telemetry, "status_text", self._hear_text)
            if gimbal is not None:
                self._keep(gimbal, "attitude", self._hear_pointing)

    def unsubscribe(self) -> None:
        """Waits for a callback that is running; afterwards none comes. May be called again."""
        while self._unsubscribe:
            self._unsubscribe.pop()()

    def _keep(self, source: Any, what: str, callback: Callable[[Any], None]) -> None:
        handle = getattr(source, f"subscribe_{what}")(lambda value, _user: callback(value))
        self._unsubscribe.append(lambda: getattr(source, f"unsubscribe_{what}")(handle))

    def _hear_connected(self, connected: bool) -> None:
        self.connected = Sample(connected, self._now_s())

    def _hear_motion(self, said: Any) -> None:
        position, velocity = said.position, said.velocity
        motion = Motion(
            np.array([position.north_m, position.east_m, position.down_m]),
            np.array([velocity.north_m_s, velocity.east_m_s, velocity.down_m_s]),
        )
        before, after = self.motion, Sample(motion, self._now_s())
        if before is not None and is_jump(before, after, self._speed_mps, self._jump_m):
            self.jumps += 1
        self.motion = after

    def _hear_attitude(self, said: Any) -> None:
        angles = map(math.radians, (said.roll_deg, said.pitch_deg, said.yaw_deg))
        self.attitude = Sample(Attitude(*angles), self._now_s())

    def _hear_rates(self, said: Any) -> None:
        self.body_rates = Sample(np.array([said.roll_rad_s, said.pitch_rad_s, said.yaw_rad_s]), self._now_s())

    def _hear_battery(self, said: Any) -> None:
        if math.isfinite(said.remaining_percent) and said.remaining_percent >= 0:  # else it does not know
            self.battery = Sample(said.remaining_percent / 100, self._now_s())

    def _hear_armed(self, armed: bool) -> None:
        self.armed = Sample(armed, self._now_s())

    def _hear_mode(self, mode: Any) -> None:
        self.mode = Sample(mode.name, self._now_s())

    def _hear_landed(self, state: Any) -> None:
        self.landed = Sample(state.name, self._now_s())

    def _hear_health(self, said: Any) -> None:
        self.health = Sample(
            Health(
                gyroscope=said.is_gyrometer_calibration_ok,
                accelerometer=said.is_accelerometer_calibration_ok,
                magnetometer=said.is_magnetometer_calibration_ok,
                local_position=said.is_local_position_ok,
                global_position=said.is_global_position_ok,
                home=said.is_home_position_ok,
                armable=said.is_armable,
            ),
            self._now_s(),
        )

    def _hear_pointing(self, said: Any) -> None:
        pointing = Pointing(
            math.radians(said.euler_angle_forward.pitch_deg), math.radians(said.euler_angle_north.yaw_deg)
        )
        self.pointing = Sample(pointing, self._now_s())

    def _hear_text(self, said: Any) -> None:
        self._texts(said.type.name.lower(), said.text)
