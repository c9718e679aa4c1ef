"""The gimbal: found, taken, pointed by a stream of angles, and watched.

A pitching gimbal follows the vehicle's nose in yaw; one that does both is locked to north. Angles go out as messages
without acknowledgement: a lost one is followed by the next, and what the gimbal does shows in its own attitude.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any

from mavsdk.plugins.gimbal import ControlMode, Gimbal, GimbalMode, SendMode
from mavsdk.plugins.mavlink_direct import MavlinkDirect, MavlinkMessage

from agents.silence import WitnessedSilence
from agents.vehicles.px4.frames import ned_yaw, wrap
from agents.vehicles.px4.refusals import refusals
from agents.vehicles.px4.telemetry_slots import Pointing, Sample
from protocol.errors import VehicleError

ATTITUDE_HZ = 20.0
"""PX4 tells the gimbal's attitude once a second unless asked."""
SET_MESSAGE_INTERVAL, GIMBAL_DEVICE_ATTITUDE_STATUS = 511, 285
"""MAVLink's numbers of the command and the message."""
ACCEPTED = 0
"""MAV_RESULT."""


@dataclass(frozen=True, slots=True)
class Aim:
    """Camera angles of the world frame: depression, and yaw, or None where the vehicle's nose decides."""

    pitch_rad: float
    yaw_rad: float | None = None

    def error_rad(self, pointing: Pointing) -> float:
        """Largest difference of an angle."""
        pitch = abs(self.pitch_rad + pointing.pitch_rad)
        return pitch if self.yaw_rad is None else max(pitch, abs(wrap(self.yaw_rad - ned_yaw(pointing.yaw_rad))))


class GimbalWatch:
    """Whether the gimbal is lost: not heard, or not where it is told, for ``lost_after_s``. Pure."""

    def __init__(self, error_rad: float, lost_after_s: float) -> None:
        self._error_rad, self._lost_after_s = error_rad, lost_after_s
        self._silence, self._disobedience = WitnessedSilence(), WitnessedSilence()
        self._obeyed_s: float | None = None
        self.lost = False
        self.reason = ""

    def judge(self, aim: Aim | None, pointing: Sample[Pointing] | None, now_s: float) -> None:
        """``aim``: what it is told; None while others may move it."""
        if pointing is None or self._silence.look(pointing.at_s, now_s) > self._lost_after_s:
            self.lost, self.reason = True, f"not heard for {self._lost_after_s:g} s"
            return
        error_rad = 0.0 if aim is None else aim.error_rad(pointing.value)
        if self._obeyed_s is None or error_rad <= self._error_rad:
            self._obeyed_s = now_s
        self.lost = self._disobedience.look(self._obeyed_s, now_s) > self._lost_after_s
        self.reason = f"{math.degrees(error_rad):.0f} degrees from where it is told to point" if self.lost else ""


class GimbalLink:
    """``follows``: the vehicle's nose decides its yaw. Calls block and belong into the executor, but `point`."""

    def __init__(self, gimbal: Gimbal, direct: MavlinkDirect, system_id: int, *, follows: bool) -> None:
        self._gimbal, self._direct, self._system_id = gimbal, direct, system_id
        self._mode = GimbalMode.YAW_FOLLOW if follows else GimbalMode.YAW_LOCK
        self._id: int | None = None

    def take(self) -> None:
        """Find it, take control of it, and have it tell its attitude often enough.

        Raises:
            VehicleError: there is no gimbal yet, or it is refused.
        """
        with refusals("taking control of the gimbal"):
            gimbals = self._gimbal.gimbal_list().gimbals
            if not gimbals:
                raise VehicleError("no gimbal manager answers; after MNT_MODE_IN was changed, restart the autopilot")
            self._gimbal.take_control(gimbals[0].gimbal_id, ControlMode.PRIMARY)
            self._ask_for_attitude(gimbals[0].gimbal_manager_component_id)
        self._id = gimbals[0].gimbal_id

    def _ask_for_attitude(self, component: int) -> None:
        fields: dict[str, Any] = {
            "target_system": self._system_id,
            "target_component": component,
            "command": SET_MESSAGE_INTERVAL,
            "confirmation": 0,
            "param1": GIMBAL_DEVICE_ATTITUDE_STATUS,
            "param2": 1e6 / ATTITUDE_HZ,
        }
        fields |= {f"param{number}": 0 for number in range(3, 8)}
        command = MavlinkMessage("COMMAND_LONG", 0, 0, self._system_id, component, json.dumps(fields))
        result = json.loads(self._direct.send_command(command).fields_json)["result"]
        if result != ACCEPTED:
            raise VehicleError(f"the gimbal's attitude at {ATTITUDE_HZ:g} Hz is refused: MAV_RESULT {result}")

    def point(self, aim: Aim) -> None:
        """Does not block; nothing happens before `take`.

        Raises:
            VehicleError: the connection is gone.
        """
        if self._id is None:
            return
        yaw_deg = 0.0 if aim.yaw_rad is None else math.degrees(ned_yaw(aim.yaw_rad))
        with refusals("pointing the gimbal"):
            self._gimbal.set_angles(self._id, 0.0, -math.degrees(aim.pitch_rad), yaw_deg, self._mode, SendMode.STREAM)
