"""What a vehicle is told: MAVLink commands, parameters, offboard and gimbal setpoints, answered as PX4 answers."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

from sim_bridge.px4_endpoint.aircraft import Aircraft
from sim_bridge.px4_endpoint.dialect import Packet, mavlink
from sim_bridge.px4_endpoint.frames import pitch_and_yaw
from sim_bridge.px4_endpoint.gimbal import DEVICE
from sim_bridge.px4_endpoint.guidance import Target
from sim_bridge.px4_endpoint.modes import Mode, mode_of
from sim_bridge.px4_endpoint.parameters import decode
from sim_bridge.px4_endpoint.streams import Streams
from sim_bridge.px4_endpoint.telemetry import GIMBAL, ON_REQUEST, STREAMS

ACCEPTED: int = mavlink.MAV_RESULT_ACCEPTED
REFUSED: int = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
DENIED: int = mavlink.MAV_RESULT_DENIED
UNSUPPORTED: int = mavlink.MAV_RESULT_UNSUPPORTED
FORCED = 21196
"""Second parameter of COMPONENT_ARM_DISARM that stops the motors in flight."""
ERROR_SEVERITY: int = mavlink.MAV_SEVERITY_ERROR
TEXT_MAX = 50
"""Bytes of one STATUSTEXT."""

Arguments = tuple[float, float, float, float, float, float, float]


class Commands:
    """Answers packets of one vehicle. ``on_setpoint`` hears every offboard setpoint that is taken."""

    def __init__(self, aircraft: Aircraft, streams: Streams, on_setpoint: Callable[[float, Target], None]) -> None:
        self._aircraft = aircraft
        self._streams = streams
        self._on_setpoint = on_setpoint
        self._handlers: dict[str, Callable[[Packet, float], Iterator[Packet]]] = {
            "COMMAND_LONG": self._command_long,
            "COMMAND_INT": self._command_int,
            "PARAM_REQUEST_LIST": self._all_parameters,
            "PARAM_REQUEST_READ": self._read_parameter,
            "PARAM_SET": self._set_parameter,
            "SET_POSITION_TARGET_LOCAL_NED": self._setpoint,
            "GIMBAL_MANAGER_SET_ATTITUDE": self._gimbal_attitude,
            "GIMBAL_MANAGER_SET_PITCHYAW": self._gimbal_angles,
            "TIMESYNC": self._timesync,
            "VISION_POSITION_ESTIMATE": self._vision,
        }
        self._commands: dict[int, Callable[[Arguments, tuple[int, int]], int]] = {
            mavlink.MAV_CMD_COMPONENT_ARM_DISARM: self._arm,
            mavlink.MAV_CMD_DO_SET_MODE: self._set_mode,
            mavlink.MAV_CMD_NAV_TAKEOFF: lambda _a, _s: self._change(Mode.TAKEOFF),
            mavlink.MAV_CMD_NAV_LAND: lambda _a, _s: self._change(Mode.LAND),
            mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH: lambda _a, _s: self._change(Mode.RTL),
            mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: self._interval,
            mavlink.MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE: self._gimbal_configure,
            mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW: self._gimbal_command,
        }

    def handle(self, packet: Packet, now_s: float) -> Iterator[Packet]:
        """Act on ``packet``, which arrived at ``now_s``; what is answered."""
        handler = self._handlers.get(packet.get_type())
        return iter(()) if handler is None else handler(packet, now_s)

    def _command_long(self, packet: Packet, _now_s: float) -> Iterator[Packet]:
        p = packet
        return self._command(p, (p.param1, p.param2, p.param3, p.param4, p.param5, p.param6, p.param7))

    def _command_int(self, packet: Packet, _now_s: float) -> Iterator[Packet]:
        p = packet
        return self._command(p, (p.param1, p.param2, p.param3, p.param4, float(p.x), float(p.y), p.z))

    def _command(self, packet: Packet, arguments: Arguments) -> Iterator[Packet]:
        source = (packet.get_srcSystem(), packet.get_srcComponent())
        for_gimbal = packet.command in (
            mavlink.MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE,
            mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW,
        )
        if self._aircraft.gimbal.silent and for_gimbal:
            return
        report: Packet | None = None
        if packet.command == mavlink.MAV_CMD_REQUEST_MESSAGE:
            report = self._report(_whole(arguments[0]))
            result = UNSUPPORTED if report is None else ACCEPTED
        else:
            command = self._commands.get(packet.command)
            result = UNSUPPORTED if command is None else command(arguments, source)
        yield mavlink.MAVLink_command_ack_message(packet.command, result, 0, 0, *source)
        if report is not None:
            yield report

    def _report(self, message: int) -> Packet | None:
        if self._aircraft.gimbal.silent and message in GIMBAL:
            return None
        make = STREAMS[message][1] if message in STREAMS else ON_REQUEST.get(message)
        return None if make is None else make(self._aircraft)

    def _interval(self, arguments: Arguments, _source: tuple[int, int]) -> int:
        interval_us = arguments[1] if math.isfinite(arguments[1]) else 0.0
        return ACCEPTED if self._streams.set(_whole(arguments[0]), interval_us) else UNSUPPORTED

    def _arm(self, arguments: Arguments, _source: tuple[int, int]) -> int:
        commander, situation = self._aircraft.commander, self._aircraft.situation
        order = _whole(arguments[0])
        if order not in (0, 1):
            return DENIED
        forced = _whole(arguments[1]) == FORCED
        done = commander.arm(situation) if order else commander.disarm(situation, forced=forced)
        return ACCEPTED if done else REFUSED

    def _set_mode(self, arguments: Arguments, _source: tuple[int, int]) -> int:
        mode = mode_of(_whole(arguments[1]), _whole(arguments[2]))
        return DENIED if mode is None else self._change(mode)

    def _change(self, mode: Mode) -> int:
        """Always acknowledged, as PX4 does: only the heartbeat tells whether the mode has changed."""
        self._aircraft.commander.command(mode, self._aircraft.situation)
        return ACCEPTED

    def _gimbal_configure(self, arguments: Arguments, source: tuple[int, int]) -> int:
        self._aircraft.gimbal.configure((arguments[0], arguments[1]), source)
        return ACCEPTED

    def _gimbal_command(self, arguments: Arguments, source: tuple[int, int]) -> int:
        angles = [math.radians(value) for value in arguments[:4]]
        return ACCEPTED if self._aircraft.gimbal.aim(source, max(_whole(arguments[4]), 0), *angles) else DENIED

    def _gimbal_attitude(self, packet: Packet, _now_s: float) -> Iterator[Packet]:
        pitch, yaw = pitch_and_yaw(packet.q) if all(map(math.isfinite, packet.q)) else (math.nan, math.nan)
        self._aim_gimbal(packet, pitch, yaw, packet.angular_velocity_y, packet.angular_velocity_z)
        return iter(())

    def _gimbal_angles(self, packet: Packet, _now_s: float) -> Iterator[Packet]:
        self._aim_gimbal(packet, packet.pitch, packet.yaw, packet.pitch_rate, packet.yaw_rate)
        return iter(())

    def _aim_gimbal(self, packet: Packet, pitch: float, yaw: float, pitch_rate: float, yaw_rate: float) -> None:
        if packet.gimbal_device_id in (0, DEVICE):
            source = (packet.get_srcSystem(), packet.get_srcComponent())
            self._aircraft.gimbal.aim(source, packet.flags, pitch, yaw, pitch_rate, yaw_rate)

    def _setpoint(self, packet: Packet, now_s: float) -> Iterator[Packet]:
        target = target_of(packet)
        if target is not None:
            self._aircraft.aim(target, now_s)
            self._on_setpoint(now_s, target)
        return iter(())

    def _all_parameters(self, _packet: Packet, _now_s: float) -> Iterator[Packet]:
        for name in self._aircraft.parameters.names:
            yield self._parameter(name)

    def _read_parameter(self, packet: Packet, _now_s: float) -> Iterator[Packet]:
        names = self._aircraft.parameters.names
        name = packet.param_id
        if packet.param_index >= 0:
            name = names[packet.param_index] if packet.param_index < len(names) else ""
        if name in self._aircraft.parameters:
            yield self._parameter(name)

    def _set_parameter(self, packet: Packet, _now_s: float) -> Iterator[Packet]:
        parameters, name = self._aircraft.parameters, packet.param_id
        if name not in parameters:
            yield from status_texts(ERROR_SEVERITY, f"unknown param: {name}")
            return
        value = decode(packet.param_value, packet.param_type)
        if packet.param_type != parameters.kind(name) or not math.isfinite(value):
            yield from status_texts(ERROR_SEVERITY, f"param types mismatch param: {name}")
            return
        parameters.set(name, value)
        yield self._parameter(name)

    def _parameter(self, name: str) -> Packet:
        parameters = self._aircraft.parameters
        index, count = parameters.names.index(name), len(parameters.names)
        return mavlink.MAVLink_param_value_message(
            name.encode(), parameters.wire(name), parameters.kind(name), count, index
        )

    def _vision(self, packet: Packet, now_s: float) -> Iterator[Packet]:
        position = (packet.x, packet.y, packet.z)
        if all(map(math.isfinite, position)):
            # Its stamp is by the sender's clock, and MAVSDK does not answer TIMESYNC: PX4 goes by the arrival then.
            self._aircraft.see(position, packet.reset_counter, now_s)
        return iter(())

    def _timesync(self, packet: Packet, now_s: float) -> Iterator[Packet]:
        if packet.tc1 == 0:
            yield mavlink.MAVLink_timesync_message(int((now_s - self._aircraft.booted_s) * 1e9), packet.ts1)


def status_texts(severity: int, text: str, number: int = 0) -> Iterator[Packet]:
    """STATUSTEXT, in several chunks where it is too long for one; ``number``, not 0, then tells it from others."""
    data = text.encode()
    chunks = [data[start : start + TEXT_MAX] for start in range(0, len(data), TEXT_MAX)]
    for index, chunk in enumerate(chunks):
        yield mavlink.MAVLink_statustext_message(severity, chunk, number if len(chunks) > 1 else 0, index)


def _whole(value: float) -> int:
    """A command's argument that is a number of something; -1 for one that is none."""
    return round(value) if math.isfinite(value) else -1


def target_of(packet: Packet) -> Target | None:
    """Of a SET_POSITION_TARGET_LOCAL_NED; None for a frame or a combination that is not flown here."""
    if packet.coordinate_frame != mavlink.MAV_FRAME_LOCAL_NED:
        return None
    mask = packet.type_mask
    mute = mavlink
    no_position = mask & mute.POSITION_TARGET_TYPEMASK_X_IGNORE
    no_velocity = mask & mute.POSITION_TARGET_TYPEMASK_VX_IGNORE
    if no_position and no_velocity:
        return None
    return Target(
        None if no_position else (packet.x, packet.y, packet.z),
        None if no_velocity else (packet.vx, packet.vy, packet.vz),
        math.nan if mask & mute.POSITION_TARGET_TYPEMASK_YAW_IGNORE else packet.yaw,
        math.nan if mask & mute.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE else packet.yaw_rate,
    )
