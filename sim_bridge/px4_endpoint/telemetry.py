"""What a vehicle reports: one function a MAVLink message, and how often PX4 sends it on an onboard link."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeAlias

from sim_bridge.px4_endpoint.aircraft import Aircraft
from sim_bridge.px4_endpoint.battery import CELLS, HOVER_A, IDLE_A
from sim_bridge.px4_endpoint.dialect import Packet, mavlink
from sim_bridge.px4_endpoint.frames import Geodetic, Vector, quaternion, unproject
from sim_bridge.px4_endpoint.gimbal import DEVICE
from sim_bridge.px4_endpoint.modes import Mode, base_mode
from sim_bridge.px4_endpoint.takeoff import CLIMB_MPS

Report: TypeAlias = Callable[[Aircraft], Packet]

SENSORS = {
    "gyro": mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO,
    "accel": mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL,
    "compass": mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG,
    "barometer": mavlink.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE,
    "gps": mavlink.MAV_SYS_STATUS_SENSOR_GPS,
    "battery": mavlink.MAV_SYS_STATUS_SENSOR_BATTERY,
}
"""Red checks by name; any other name turns the pre-arm check alone red."""
PREARM: int = mavlink.MAV_SYS_STATUS_PREARM_CHECK
VERSION = 1 << 24 | 16 << 16 | 1 << 8 | 255
"""v1.16.1, release."""
UNKNOWN_16 = 65535
NAN = math.nan


def milliseconds(aircraft: Aircraft) -> int:
    """PX4's time since boot; here, until it has booted again, that of the machine: stamps of all vehicles compare."""
    return int(aircraft.up_s * 1e3) & 0xFFFFFFFF


def heartbeat(aircraft: Aircraft) -> Packet:
    commander = aircraft.commander
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_QUADROTOR,
        mavlink.MAV_AUTOPILOT_PX4,
        base_mode(commander.mode, armed=commander.armed),
        int(commander.mode),
        mavlink.MAV_STATE_ACTIVE if commander.armed else mavlink.MAV_STATE_STANDBY,
        3,
    )


def sys_status(aircraft: Aircraft) -> Packet:
    present = PREARM
    for bit in SENSORS.values():
        present |= bit
    healthy = present
    for fault in aircraft.red:
        healthy &= ~(PREARM | SENSORS.get(fault, 0))
    battery = aircraft.battery
    return mavlink.MAVLink_sys_status_message(
        present, present, healthy, 300, int(battery.cell_v * CELLS * 1e3), int(_current(aircraft) * 100),
        _per_cent(aircraft), 0, 0, 0, 0, 0, 0,
    )  # fmt: skip


def extended_sys_state(aircraft: Aircraft) -> Packet:
    ground, down = aircraft.ground, aircraft.commanded[2]
    state = mavlink.MAV_LANDED_STATE_IN_AIR
    if ground.landed:
        state = mavlink.MAV_LANDED_STATE_ON_GROUND
    elif aircraft.guidance.takeoff_to is not None and down < -CLIMB_MPS:
        state = mavlink.MAV_LANDED_STATE_TAKEOFF
    elif aircraft.commander.mode is Mode.LAND:
        state = mavlink.MAV_LANDED_STATE_LANDING
    return mavlink.MAVLink_extended_sys_state_message(mavlink.MAV_VTOL_STATE_UNDEFINED, state)


def attitude(aircraft: Aircraft) -> Packet:
    body = aircraft.body
    return mavlink.MAVLink_attitude_message(
        milliseconds(aircraft), body.roll, body.pitch, body.yaw, 0.0, 0.0, body.yaw_rate
    )


def attitude_quaternion(aircraft: Aircraft) -> Packet:
    body = aircraft.body
    return mavlink.MAVLink_attitude_quaternion_message(
        milliseconds(aircraft), *quaternion(body.roll, body.pitch, body.yaw), 0.0, 0.0, body.yaw_rate
    )


def local_position_ned(aircraft: Aircraft) -> Packet:
    here = aircraft.estimate
    return mavlink.MAVLink_local_position_ned_message(milliseconds(aircraft), *here.position, *here.velocity)


def position_target_local_ned(aircraft: Aircraft) -> Packet:
    ignored = mavlink.POSITION_TARGET_TYPEMASK_X_IGNORE | mavlink.POSITION_TARGET_TYPEMASK_Y_IGNORE
    ignored |= mavlink.POSITION_TARGET_TYPEMASK_Z_IGNORE
    target = aircraft.guidance.target
    yaw = target.yaw if target is not None else NAN
    return mavlink.MAVLink_position_target_local_ned_message(
        milliseconds(aircraft), mavlink.MAV_FRAME_LOCAL_NED, ignored, NAN, NAN, NAN, *aircraft.commanded,
        NAN, NAN, NAN, yaw, NAN,
    )  # fmt: skip


def global_position_int(aircraft: Aircraft) -> Packet:
    here = aircraft.estimate
    latitude, longitude, height = unproject(aircraft.origin, here.position)
    n, e, d = (int(v * 100) for v in here.velocity)
    heading = int(math.degrees(here.yaw) % 360 * 100)
    above_home = aircraft.guidance.home[2] - here.position[2]
    return mavlink.MAVLink_global_position_int_message(
        milliseconds(aircraft), *_e7(latitude, longitude), int(height * 1e3), int(above_home * 1e3), n, e, d, heading
    )


def gps_raw_int(aircraft: Aircraft) -> Packet:
    here = aircraft.estimate
    latitude, longitude, height = unproject(aircraft.origin, here.position)
    lost = "gps" in aircraft.faults
    fix, satellites = (mavlink.GPS_FIX_TYPE_NO_FIX, 0) if lost else (mavlink.GPS_FIX_TYPE_3D_FIX, 10)
    speed = int(math.hypot(here.velocity[0], here.velocity[1]) * 100)
    return mavlink.MAVLink_gps_raw_int_message(
        int(aircraft.up_s * 1e6), fix, *_e7(latitude, longitude), int(height * 1e3), 80, 120, speed, UNKNOWN_16,
        satellites,
    )  # fmt: skip


def gps_global_origin(aircraft: Aircraft) -> Packet:
    latitude, longitude, height = aircraft.origin
    return mavlink.MAVLink_gps_global_origin_message(
        *_e7(latitude, longitude), round(height * 1e3), int(aircraft.up_s * 1e6)
    )


def home_position(aircraft: Aircraft) -> Packet:
    home: Vector = aircraft.guidance.home
    place: Geodetic = unproject(aircraft.origin, home)
    return mavlink.MAVLink_home_position_message(
        *_e7(place[0], place[1]), round(place[2] * 1e3), *home, [1.0, 0.0, 0.0, 0.0], NAN, NAN, NAN,
        int(aircraft.up_s * 1e6),
    )  # fmt: skip


def battery_status(aircraft: Aircraft) -> Packet:
    battery = aircraft.battery
    cells = [int(battery.cell_v * 1e3)] * CELLS + [UNKNOWN_16] * (10 - CELLS)
    return mavlink.MAVLink_battery_status_message(
        0, mavlink.MAV_BATTERY_FUNCTION_ALL, mavlink.MAV_BATTERY_TYPE_LIPO, 2500, cells,
        int(_current(aircraft) * 100), -1, -1, _per_cent(aircraft),
        int(battery.share * battery.flight_s), mavlink.MAV_BATTERY_CHARGE_STATE_OK,
    )  # fmt: skip


def autopilot_version(aircraft: Aircraft) -> Packet:
    abilities = (
        mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
        | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
        | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
        | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
        | mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    )
    none = [0] * 8
    system = int(aircraft.parameters["MAV_SYS_ID"])
    return mavlink.MAVLink_autopilot_version_message(abilities, VERSION, 0, VERSION, 0, none, none, none, 0, 0, system)


def gimbal_manager_information(aircraft: Aircraft) -> Packet:
    pitch = math.radians(aircraft.parameters["MNT_RANGE_PITCH"]) / 2
    yaw = math.radians(aircraft.parameters["MNT_RANGE_YAW"]) / 2
    return mavlink.MAVLink_gimbal_manager_information_message(
        milliseconds(aircraft), _ABILITIES, DEVICE, 0.0, 0.0, -pitch, pitch, -yaw, yaw
    )


def gimbal_manager_status(aircraft: Aircraft) -> Packet:
    gimbal = aircraft.gimbal
    return mavlink.MAVLink_gimbal_manager_status_message(
        milliseconds(aircraft), gimbal.flags, DEVICE, *gimbal.controller, 0, 0
    )


def gimbal_device_information(aircraft: Aircraft) -> Packet:
    pitch = math.radians(aircraft.parameters["MNT_RANGE_PITCH"]) / 2
    yaw = math.radians(aircraft.parameters["MNT_RANGE_YAW"]) / 2
    return mavlink.MAVLink_gimbal_device_information_message(
        milliseconds(aircraft), b"", b"", b"", 0, 0, 0, _ABILITIES & 0xFFFF, 0, 0.0, 0.0, -pitch, pitch, -yaw, yaw,
        DEVICE,
    )  # fmt: skip


def gimbal_device_attitude_status(aircraft: Aircraft) -> Packet:
    gimbal = aircraft.gimbal
    return mavlink.MAVLink_gimbal_device_attitude_status_message(
        0, 0, milliseconds(aircraft), gimbal.flags, list(quaternion(0.0, gimbal.pitch.angle, gimbal.yaw.angle)),
        0.0, gimbal.pitch.rate, gimbal.yaw.rate, 0, aircraft.body.yaw, aircraft.body.yaw_rate, DEVICE,
    )  # fmt: skip


def _per_cent(aircraft: Aircraft) -> int:
    return math.ceil(aircraft.battery.share * 100) if aircraft.knows_battery else -1


def _current(aircraft: Aircraft) -> float:
    return HOVER_A if aircraft.commander.armed else IDLE_A


def _e7(latitude: float, longitude: float) -> tuple[int, int]:
    return round(latitude * 1e7), round(longitude * 1e7)


_ABILITIES: int = (
    mavlink.GIMBAL_MANAGER_CAP_FLAGS_HAS_NEUTRAL
    | mavlink.GIMBAL_MANAGER_CAP_FLAGS_HAS_PITCH_AXIS
    | mavlink.GIMBAL_MANAGER_CAP_FLAGS_HAS_PITCH_LOCK
    | mavlink.GIMBAL_MANAGER_CAP_FLAGS_HAS_YAW_AXIS
    | mavlink.GIMBAL_MANAGER_CAP_FLAGS_HAS_YAW_FOLLOW
    | mavlink.GIMBAL_MANAGER_CAP_FLAGS_HAS_YAW_LOCK
)

STREAMS: dict[int, tuple[float, Report]] = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: (1.0, heartbeat),
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: (5.0, sys_status),
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: (1.0, extended_sys_state),
    mavlink.MAVLINK_MSG_ID_ATTITUDE: (100.0, attitude),
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: (50.0, attitude_quaternion),
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: (30.0, local_position_ned),
    mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: (10.0, position_target_local_ned),
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: (50.0, global_position_int),
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: (8.0, gps_raw_int),
    mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: (1.0, gps_global_origin),
    mavlink.MAVLINK_MSG_ID_HOME_POSITION: (0.5, home_position),
    mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: (0.5, battery_status),
    mavlink.MAVLINK_MSG_ID_GIMBAL_MANAGER_STATUS: (0.5, gimbal_manager_status),
    mavlink.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS: (1.0, gimbal_device_attitude_status),
}
"""Message id to default rate, Hz, and how it is made. PX4 v1.16's rates on an onboard link, rounded to the
endpoint's step, but without ODOMETRY, which repeats the others."""

ON_REQUEST: dict[int, Report] = {
    mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: autopilot_version,
    mavlink.MAVLINK_MSG_ID_GIMBAL_MANAGER_INFORMATION: gimbal_manager_information,
    mavlink.MAVLINK_MSG_ID_GIMBAL_DEVICE_INFORMATION: gimbal_device_information,
}
"""What is sent only when asked for."""

POSITION = (mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT)
"""Messages that are not sent while there is no position."""

GIMBAL = (
    mavlink.MAVLINK_MSG_ID_GIMBAL_MANAGER_INFORMATION,
    mavlink.MAVLINK_MSG_ID_GIMBAL_DEVICE_INFORMATION,
    mavlink.MAVLINK_MSG_ID_GIMBAL_MANAGER_STATUS,
    mavlink.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS,
)
"""Messages that a silent gimbal's manager does not send."""
