"""One PX4-like vehicle on its link, and the faults that can be put into it.

Faults are methods and attributes, callable from any thread; `docs/px4.md` lists them for scenario tests:

=====================================  ================================================================================
``refuse_offboard = True``             OFFBOARD is acknowledged, but the mode stays
``deny_arming = True``                 arming is refused with a status text
``fail_checks("gps", ...)``            red checks (`telemetry.SENSORS`, or any text); none: all green again
``silent = True``                      it sends nothing more, but hears
``cut = True``                         it neither sends nor hears
``set_battery(share)``                 0 to 1
``tells_battery = False``              it does not know its share
``power_off_s = 3.0``                  how long changing the battery takes its power; 0: it is fed meanwhile
``wake_elsewhere((x, y, z))``          after its next boot its estimate is off by this, world metres
``jump((x, y, z))``                    its position estimate moves at once, world metres; the vehicle does not
``push((x, y, z), seconds)``           it is carried along, world m/s, on top of what it flies: out of the fence, say
``gimbal_stuck = True``                the gimbal reports, but does not move
``gimbal_silent = True``               the gimbal and its manager say nothing
``pilot("POSCTL", (0, 0, 0))``         a pilot switches the mode, sticks asking for a velocity (world, m/s)
``pilot("OFFBOARD")``                  ... and gives it back
=====================================  ================================================================================
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable

from protocol.mission import Drone, Mission
from sim_bridge.px4_endpoint.aircraft import Aircraft, Pose
from sim_bridge.px4_endpoint.commands import Commands, status_texts
from sim_bridge.px4_endpoint.frames import Vector, ned
from sim_bridge.px4_endpoint.guidance import Target
from sim_bridge.px4_endpoint.link import Link
from sim_bridge.px4_endpoint.modes import Mode
from sim_bridge.px4_endpoint.setpoint_times import SetpointTimes
from sim_bridge.px4_endpoint.streams import Streams
from sim_bridge.px4_endpoint.telemetry import GIMBAL, POSITION, STREAMS

TEXT_NUMBER_MAX = 0xFFFF

log = logging.getLogger(__name__)


class Vehicle:
    """Belongs to the endpoint's thread, but for the faults above and what only reads.

    Raises:
        MissionError: its connection is not ``udpin://``.
    """

    def __init__(self, mission: Mission, drone: Drone) -> None:
        self.drone = drone
        self.aircraft = Aircraft(mission, drone)
        self.link = Link(mission.vehicle_url(drone), drone.mavlink_system)
        self.setpoints = SetpointTimes()
        self.on_setpoint: Callable[[int, float, Target], None] | None = None
        """Called with the drone's id, the arrival by CLOCK_MONOTONIC and the setpoint, on the endpoint's thread."""
        self._streams = Streams()
        self._commands = Commands(self.aircraft, self._streams, self._heard_setpoint)
        self._texts = 0
        """Number of the newest one."""
        self._orders: deque[Callable[[], None]] = deque()
        """Faults that must not fall into the middle of a step."""

    @property
    def mode(self) -> Mode:
        return self.aircraft.commander.mode

    @property
    def armed(self) -> bool:
        return self.aircraft.commander.armed

    @property
    def landed(self) -> bool:
        return self.aircraft.ground.landed

    @property
    def pose(self) -> Pose:
        """True camera pose: x, y, z, yaw, depression; world frame."""
        return self.aircraft.pose

    def step(self, now_s: float, dt: float) -> None:
        """Advance the vehicle and send what is due."""
        while self._orders:
            self._orders.popleft()()
        boots = self.aircraft.boots
        self.aircraft.step(now_s, dt)
        if self.aircraft.is_off:
            return
        if self.aircraft.boots > boots:
            self._streams.reset()
            log.info("drone %d: booted", self.drone.id)
        self._tell()
        mute = (*(GIMBAL if self.aircraft.gimbal.silent else ()), *(() if self.aircraft.has_position else POSITION))
        for message in self._streams.due(now_s):
            if message not in mute:
                self.link.send(STREAMS[message][1](self.aircraft))

    def read(self, now_s: float) -> None:
        """Act on what has come in."""
        packets = self.link.receive()
        if self.aircraft.is_off:
            return
        for packet in packets:
            for answer in self._commands.handle(packet, now_s):
                self.link.send(answer)
        self._tell()

    def close(self) -> None:
        self.link.close()

    def _tell(self) -> None:
        texts = self.aircraft.commander.texts
        for severity, text in texts:
            log.info("drone %d: %s", self.drone.id, text)
            self._texts = self._texts % TEXT_NUMBER_MAX + 1
            for packet in status_texts(severity, text, self._texts):
                self.link.send(packet)
        texts.clear()

    def _heard_setpoint(self, now_s: float, target: Target) -> None:
        self.setpoints.arrived(now_s)
        if self.on_setpoint is not None:
            self.on_setpoint(self.drone.id, now_s, target)

    def pilot(self, mode: str, sticks: tuple[float, float, float] | None = (0.0, 0.0, 0.0)) -> None:
        """Switch to the mode of this name (`modes.Mode`); ``sticks`` None: without a remote control it comes down.

        Raises:
            KeyError: there is no such mode.
        """
        wanted = Mode[mode]
        self._orders.append(lambda: self._switch(wanted, sticks))

    def _switch(self, mode: Mode, sticks: tuple[float, float, float] | None) -> None:
        self.aircraft.guidance.sticks = None if sticks is None else ned(sticks)
        self.aircraft.commander.command(mode, self.aircraft.situation)

    def fail_checks(self, *names: str) -> None:
        self.aircraft.faults = names

    def set_battery(self, share: float) -> None:
        self.aircraft.battery.share = share

    @property
    def tells_battery(self) -> bool:
        return self.aircraft.tells_battery

    @tells_battery.setter
    def tells_battery(self, value: bool) -> None:
        self.aircraft.tells_battery = value

    @property
    def power_off_s(self) -> float:
        return self.aircraft.power_off_s

    @power_off_s.setter
    def power_off_s(self, value: float) -> None:
        self.aircraft.power_off_s = value

    def wake_elsewhere(self, by: Vector) -> None:
        self.aircraft.boot_error = ned(by)

    def jump(self, by: Vector) -> None:
        self._orders.append(lambda: self.aircraft.jump(ned(by)))

    def push(self, velocity: Vector, seconds: float) -> None:
        self._orders.append(lambda: self.aircraft.push(ned(velocity), seconds))

    @property
    def refuse_offboard(self) -> bool:
        return self.aircraft.commander.refuse_offboard

    @refuse_offboard.setter
    def refuse_offboard(self, value: bool) -> None:
        self.aircraft.commander.refuse_offboard = value

    @property
    def deny_arming(self) -> bool:
        return self.aircraft.commander.deny_arming

    @deny_arming.setter
    def deny_arming(self, value: bool) -> None:
        self.aircraft.commander.deny_arming = value

    @property
    def silent(self) -> bool:
        return self.link.silent

    @silent.setter
    def silent(self, value: bool) -> None:
        self.link.silent = value

    @property
    def cut(self) -> bool:
        return self.link.silent and self.link.deaf

    @cut.setter
    def cut(self, value: bool) -> None:
        self.link.silent = self.link.deaf = value

    @property
    def gimbal_stuck(self) -> bool:
        return self.aircraft.gimbal.stuck

    @gimbal_stuck.setter
    def gimbal_stuck(self, value: bool) -> None:
        self.aircraft.gimbal.stuck = value

    @property
    def gimbal_silent(self) -> bool:
        return self.aircraft.gimbal.silent

    @gimbal_silent.setter
    def gimbal_silent(self, value: bool) -> None:
        self.aircraft.gimbal.silent = value
