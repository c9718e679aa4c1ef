"""PX4's parameters: those that the endpoint obeys, and some that ground stations ask for; and how they travel.

PX4 sends an int32 in the four bytes of PARAM_VALUE's float (MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE).
"""

from __future__ import annotations

import struct

from sim_bridge.px4_endpoint.dialect import mavlink

DEFAULTS: dict[str, int | float] = {
    "BAT1_N_CELLS": 4,
    "BAT_CRIT_THR": 0.07,
    "BAT_EMERGEN_THR": 0.05,
    "BAT_LOW_THR": 0.15,
    "COM_ARM_WO_GPS": 1,
    "COM_DISARM_LAND": 2.0,
    "COM_DISARM_PRFLT": 10.0,
    "COM_LOW_BAT_ACT": 0,
    "COM_OBL_RC_ACT": 0,
    "COM_OF_LOSS_T": 1.0,
    "COM_RCL_EXCEPT": 0,
    "COM_RC_IN_MODE": 1,
    "EKF2_EVP_NOISE": 0.1,
    "EKF2_EV_CTRL": 15,
    "EKF2_EV_DELAY": 0.0,
    "EKF2_GPS_CTRL": 7,
    "EKF2_HGT_REF": 1,
    "GF_ACTION": 2,
    "GF_MAX_HOR_DIST": 0.0,
    "GF_MAX_VER_DIST": 0.0,
    "GF_PREDICT": 0,
    "GF_SOURCE": 0,
    "MAV_COMP_ID": 1,
    "MAV_SYS_ID": 1,
    "MC_YAWRATE_MAX": 200.0,
    "MC_YAW_P": 2.8,
    "MIS_TAKEOFF_ALT": 2.5,
    "MNT_MODE_IN": 4,
    "MNT_MODE_OUT": 0,
    "MNT_RANGE_PITCH": 90.0,
    "MNT_RANGE_YAW": 360.0,
    "MPC_ACC_HOR": 3.0,
    "MPC_ACC_HOR_MAX": 5.0,
    "MPC_LAND_SPEED": 0.7,
    "MPC_TKO_RAMP_T": 3.0,
    "MPC_TKO_SPEED": 1.5,
    "MPC_XY_CRUISE": 5.0,
    "MPC_XY_P": 0.95,
    "MPC_XY_VEL_MAX": 12.0,
    "MPC_Z_P": 1.0,
    "MPC_Z_VEL_MAX_DN": 1.5,
    "MPC_Z_VEL_MAX_UP": 3.0,
    "MPC_Z_VEL_P_ACC": 4.0,
    "NAV_ACC_RAD": 10.0,
    "NAV_DLL_ACT": 0,
    "NAV_MC_ALT_RAD": 0.8,
    "NAV_RCL_ACT": 2,
    "RTL_CONE_ANG": 45,
    "RTL_DESCEND_ALT": 30.0,
    "RTL_LAND_DELAY": 0.0,
    "RTL_RETURN_ALT": 60.0,
    "RTL_TYPE": 0,
    "SYS_AUTOSTART": 10040,
}
"""PX4 v1.16's own defaults, for the multicopter that its simulation flies, but for MNT_MODE_IN, which is set as a
vehicle with a gimbal has it."""


class Parameters:
    def __init__(self) -> None:
        self._values = dict(DEFAULTS)
        self.names = sorted(self._values)

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def set(self, name: str, value: float) -> None:
        """Raises `KeyError` for one that is not there."""
        self._values[name] = type(self._values[name])(value)

    def kind(self, name: str) -> int:
        """MAV_PARAM_TYPE."""
        integer = isinstance(self._values[name], int)
        return int(mavlink.MAV_PARAM_TYPE_INT32 if integer else mavlink.MAV_PARAM_TYPE_REAL32)

    def wire(self, name: str) -> float:
        return encode(self._values[name])


def encode(value: float) -> float:
    """The float of PARAM_VALUE and PARAM_SET."""
    if isinstance(value, int):
        return float(struct.unpack("<f", struct.pack("<i", value))[0])
    return float(value)


def decode(wire: float, kind: int) -> int | float:
    """Reverse of `encode`; ``kind`` is a MAV_PARAM_TYPE."""
    if kind == mavlink.MAV_PARAM_TYPE_INT32:
        return int(struct.unpack("<i", struct.pack("<f", wire))[0])
    return wire
