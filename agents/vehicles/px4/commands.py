"""What a vehicle can be told: commands that block until they are answered, and setpoints that do not.

`Action.arm_force` is not among them: in MAVSDK 4.1.0 it disarms, in flight too.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from mavsdk import System
from mavsdk.plugins.action import Action
from mavsdk.plugins.offboard import Offboard, VelocityNedYaw

from agents.vehicles.px4.authority import Step
from agents.vehicles.px4.refusals import refusals
from protocol.geometry import Floats


class Commands:
    def __init__(self, system: System) -> None:
        """Raises: VehicleError: the connection is gone."""
        with refusals("commanding the vehicle"):
            action, self._offboard = Action(system), Offboard(system)
        self._by_step: dict[Step, Callable[[], object]] = {
            "arm": action.arm,
            "disarm": action.disarm,
            "take_off": action.takeoff,
            "offboard": self._offboard.start,
            "hold": action.hold,
            "land": action.land,
        }

    def give(self, step: Step) -> None:
        """Blocks, for at most two seconds (MAVSDK gives up by then). Its effect shows in telemetry, or it does not.

        Raises:
            VehicleError: refused, or not answered.
        """
        with refusals(step.replace("_", " ")):
            self._by_step[step]()

    def fly(self, velocity_ned: Floats, ned_yaw_rad: float) -> None:
        """Velocity (3,), m/s, and yaw. Does not block; MAVSDK repeats it every 50 ms until the next one.

        Raises:
            VehicleError: the connection is gone.
        """
        north, east, down = velocity_ned.tolist()
        with refusals("sending a setpoint"):
            self._offboard.set_velocity_ned(VelocityNedYaw(north, east, down, math.degrees(ned_yaw_rad)))
