"""From a connected vehicle to one that is fit to fly: its place in the world, parameters, gimbal and checks."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np
from mavsdk import System
from mavsdk.plugins.gimbal import Gimbal
from mavsdk.plugins.mavlink_direct import MavlinkDirect
from mavsdk.plugins.param import Param
from mavsdk.plugins.telemetry import Telemetry

from agents.vehicles.px4.commands import Commands
from agents.vehicles.px4.external_pose import ExternalPoseLink
from agents.vehicles.px4.frames import GlobalPosition, LocalFrame, offset, world_yaw
from agents.vehicles.px4.gimbal import Aim, GimbalLink
from agents.vehicles.px4.parameters import apply_parameters, needed_parameters
from agents.vehicles.px4.preflight import Item, Readings, checklist, red
from agents.vehicles.px4.refusals import refusals
from agents.vehicles.px4.telemetry_slots import Sample, TelemetrySlots, Value
from protocol.errors import VehicleError
from protocol.mission import Mission

POLL_S = 0.2
TELEMETRY_HZ = 50.0
"""Of position and attitude; PX4 gives 30 and 98 on an onboard link, and less on a telemetry radio."""
SLOW_S = 3.0
"""What PX4 tells once a second (mode, landed or not) may be so old at the checks."""


@dataclass(frozen=True, slots=True)
class Prepared:
    """What flying takes."""

    commands: Commands
    frame: LocalFrame
    gimbal: GimbalLink | None
    aim: Aim | None
    """Where the gimbal points; None without one."""
    loss_action: int
    """COM_OBL_RC_ACT."""


class Preparation:
    """Steps that block, each done once; those that fail are tried again until the time is over."""

    def __init__(
        self,
        system: System,
        slots: TelemetrySlots,
        mission: Mission,
        drone: int,
        external: ExternalPoseLink | None = None,
    ) -> None:
        """``external``: what passes poses from outside on, where they are asked for. Raises: VehicleError: the
        connection is gone."""
        self._slots, self._mission, self._drone, self._external = slots, mission, drone, external
        self._start = mission.drone(drone).start
        mount = mission.vehicles.camera_mount
        with refusals("attaching to the vehicle"):
            self._telemetry, self._param = Telemetry(system), Param(system)
            gimbal, self._gimbal = None, None
            if mount != "fixed":
                gimbal, direct = Gimbal(system), MavlinkDirect(system)
                self._gimbal = GimbalLink(gimbal, direct, system.get_system_id(), follows=mount == "gimbal_pitch")
        self.commands = Commands(system)
        self._frame: LocalFrame | None = None
        self._values: dict[str, float] = {}
        self._aim: Aim | None = None
        self.changes: list[str] = []
        """Parameters that were set."""
        self._steps: dict[str, Callable[[], None]] = {
            "telemetry rate": self._ask_for_rates,
            "place in the world": self._find_place,
            "parameters": self._set_parameters,
        }
        if self._gimbal is not None:
            self._steps["gimbal control"] = self._gimbal.take
        self.undone = dict.fromkeys(self._steps, "not tried yet")
        self._since_s = -math.inf
        """What was heard before that is no longer true: -inf before the first flight."""
        slots.subscribe(system, self._telemetry, gimbal)

    def start_over(self, now_s: float) -> None:
        """All of it is undone, and unknown what was heard before ``now_s``: the vehicle may have booted since. A
        `go_on` that runs meanwhile does nothing for that any more."""
        self.undone, self.changes, self._since_s = dict.fromkeys(self._steps, "not tried yet"), [], now_s

    def go_on(self) -> None:
        """Do what is undone, in order; blocks."""
        undone = self.undone
        for name in list(undone):
            try:
                self._steps[name]()
                del undone[name]
            except VehicleError as error:
                undone[name] = str(error)
                return

    def _ask_for_rates(self) -> None:
        with refusals(f"position and attitude at {TELEMETRY_HZ:g} Hz"):
            self._telemetry.set_rate_position_velocity_ned(TELEMETRY_HZ)
            self._telemetry.set_rate_attitude_euler(TELEMETRY_HZ)

    def _find_place(self) -> None:
        origin = self._mission.vehicles.origin
        if origin is None:
            self._frame = LocalFrame(np.zeros(3))
            return
        with refusals("asking for the local frame's origin"):
            said = self._telemetry.get_gps_global_origin()
        local = GlobalPosition(said.latitude_deg, said.longitude_deg, said.altitude_m)
        if not all(map(math.isfinite, (local.latitude_deg, local.longitude_deg, local.altitude_m))):
            raise VehicleError("the local frame's origin is not known yet")
        self._frame = LocalFrame(offset(GlobalPosition(*origin), local))

    def _set_parameters(self) -> None:
        readings = self.readings(-math.inf)
        if readings.position is None or readings.landed in (None, "UNKNOWN"):
            raise VehicleError("wait for the position")
        home = None if readings.is_airborne else readings.position
        self._values = needed_parameters(self._mission, home, self._start[2])
        self.changes += apply_parameters(self._param, self._values)

    def point(self, readings: Readings) -> None:
        """The gimbal to where the mission starts, or on where it points if the vehicle flies already."""
        if self._gimbal is None or "gimbal control" in self.undone:
            return
        yaws = self._mission.vehicles.camera_mount == "gimbal"
        if readings.is_airborne:
            if self._aim is None and readings.pointing is not None:
                low, high = self._mission.flight.pitch_limits_rad
                pitch_rad = min(max(-readings.pointing.pitch_rad, low), high)
                self._aim = Aim(pitch_rad, world_yaw(readings.pointing.yaw_rad) if yaws else None)
        else:
            self._aim = Aim(self._start[4], self._start[3] if yaws else None)
        if self._aim is not None:
            self._gimbal.point(self._aim)

    def readings(self, oldest_s: float) -> Readings:
        """``oldest_s``: what came before that is not known."""
        slots, oldest_s = self._slots, max(oldest_s, self._since_s)
        health = slots.health

        def fresh(sample: Sample[Value] | None) -> Value | None:
            return sample.value if sample is not None and sample.at_s >= oldest_s else None

        motion, position = fresh(slots.motion), None
        if motion is not None and self._frame is not None:
            position = self._frame.to_world(motion.position)
        seen = None
        if self._external is not None:
            seen = self._external.sent_s is not None and self._external.sent_s >= oldest_s
        return Readings(
            seen=seen,
            position=position,
            has_attitude=fresh(slots.attitude) is not None,
            mode=fresh(slots.mode),
            landed=fresh(slots.landed),
            armed=fresh(slots.armed),
            battery=fresh(slots.battery),
            health=health.value if health is not None and health.at_s >= self._since_s else None,  # told seldom
            pointing=fresh(slots.pointing),
            undone=dict(self.undone),
        )

    def items(self, readings: Readings) -> list[Item]:
        return checklist(readings, self._mission, self._drone, self._aim, again=math.isfinite(self._since_s))

    def result(self) -> Prepared:
        if self._frame is None:
            raise VehicleError("the vehicle's place in the world is not known")
        return Prepared(self.commands, self._frame, self._gimbal, self._aim, int(self._values["COM_OBL_RC_ACT"]))


async def prepare_vehicle(
    preparation: Preparation,
    executor: Executor,
    now_s: Callable[[], float],
    events: Callable[[str, str], None],
    on_red: Callable[[list[Item]], None],
) -> Prepared:
    """Wait for every item to become green. ``on_red``: called with those that are not, again and again; what it raises
    ends the wait.

    Raises:
        VehicleError: the connection is gone.
    """
    while True:
        await asyncio.get_running_loop().run_in_executor(executor, preparation.go_on)
        readings = preparation.readings(now_s() - SLOW_S)
        preparation.point(readings)
        items = preparation.items(readings)
        faults = red(items)
        if not faults:
            break
        on_red(faults)
        await asyncio.sleep(POLL_S)
    for change in preparation.changes:
        events("info", f"parameter {change}")
    where = "in the air" if readings.is_airborne else "on the ground"
    events("info", f"preflight, {where}: {', '.join(item.name for item in items)}: all fine")
    return preparation.result()


class UntilTooLate:
    """Of the checks before the first take-off: whoever stays red for ``vehicles.preflight_s`` does not fly."""

    def __init__(self, mission: Mission, drone: int, now_s: Callable[[], float]) -> None:
        self._drone, self._now_s = drone, now_s
        self._deadline_s = now_s() + mission.vehicles.preflight_s

    def __call__(self, faults: list[Item]) -> None:
        """Raises: VehicleError: names each item that stayed red, with the reason."""
        if self._now_s() > self._deadline_s:
            listed = "\n".join(f"  {item.name}: {item.fault}" for item in faults)
            raise VehicleError(f"drone {self._drone} is not fit to fly:\n{listed}")
