"""The autopilot's parameters that a mission needs: what happens when we fall silent, how fast, how far, how high."""

from __future__ import annotations

import math
from collections.abc import Mapping

from mavsdk.plugins.param import Param, ParamError, ParamResult

from agents.vehicles.px4.refusals import refusals
from protocol.errors import VehicleError
from protocol.geometry import Floats
from protocol.mission import Mission

HOLD_ON_LOSS = 5
"""COM_OBL_RC_ACT. PX4's default lands a vehicle without remote control wherever it is."""
LOSS_S = 1.0
"""COM_OF_LOSS_T."""
FENCE_HOLDS = 2
"""GF_ACTION."""
SPEED_HEADROOM = 1.5
"""PX4's velocity limits over what is commanded: below it they only cut overshoot, and a gust could not be flown out."""
SPEED_LEAST_MPS = 1.0
"""PX4 lands and takes off badly with less."""
CLIMBED_M = 0.3
"""NAV_MC_ALT_RAD: a take-off ends so far below its height; by default 0.8 m."""
MOUNT_BY_MAVLINK = 4
"""MNT_MODE_IN: gimbal protocol v2."""
MOUNT_PITCH_DEG, MOUNT_YAW_DEG = 180.0, 360.0
"""MNT_RANGE_PITCH and _YAW, which matter to gimbals on PWM outputs alone. By default PX4 pitches no lower than 45
degrees; a gimbal whose outputs span another range says so in ``vehicles.parameters``."""
SAME = 1e-5
"""Relative difference of two equal parameters: they travel as float32."""


def needed_parameters(mission: Mission, home: Floats | None, start_m: float) -> dict[str, float]:
    """Name to value. ``home`` (3,): world position of a vehicle on the ground; None for one in the air, whose take-off
    height and fence belong to a home that is not known any more. ``start_m``: world z to climb to."""
    vehicles, flight = mission.vehicles, mission.flight
    speed = SPEED_HEADROOM * flight.speed_max_mps
    values: dict[str, float] = {
        "COM_OBL_RC_ACT": HOLD_ON_LOSS,
        "COM_OF_LOSS_T": LOSS_S,
        "MPC_XY_VEL_MAX": max(SPEED_LEAST_MPS, math.sqrt(2) * speed),  # each component may reach its bound
        "MPC_Z_VEL_MAX_UP": max(SPEED_LEAST_MPS, speed),
        "MPC_Z_VEL_MAX_DN": max(SPEED_LEAST_MPS, speed),
        "NAV_MC_ALT_RAD": CLIMBED_M,
    }
    if vehicles.camera_mount != "fixed":
        values["MNT_MODE_IN"] = MOUNT_BY_MAVLINK
        values["MNT_RANGE_PITCH"], values["MNT_RANGE_YAW"] = MOUNT_PITCH_DEG, MOUNT_YAW_DEG
    if home is not None:
        x, y, z = home.tolist()
        bounds = zip(flight.lower_m, flight.upper_m, (x, y), strict=False)
        aside = [max(abs(low - at), abs(high - at)) for low, high, at in bounds]
        # The agent lands one margin outside; the autopilot stops what is two margins out.
        margin = 2 * vehicles.fence_margin_m
        values["GF_ACTION"] = FENCE_HOLDS
        values["GF_MAX_HOR_DIST"] = math.hypot(*aside) + margin
        values["GF_MAX_VER_DIST"] = flight.upper_m[2] - z + margin
        values["MIS_TAKEOFF_ALT"] = start_m - z
    return values | {parameter.name: parameter.value for parameter in vehicles.parameters}


def apply_parameters(param: Param, values: Mapping[str, float]) -> list[str]:
    """Set those that differ, and read them back; "NAME: old -> new" of each that was changed. Blocks.

    Raises:
        VehicleError: names every one that is unknown, refused or was not kept, with the reason.
    """
    changes, faults = [], []
    for name, value in values.items():
        try:
            before, whole = _read(param, name, value)
            if not math.isclose(before, value, rel_tol=SAME, abs_tol=SAME):
                _write(param, name, value, whole=whole)
                changes.append(f"{name}: {before:g} -> {value:g}")
        except VehicleError as error:
            faults.append(str(error))
    if faults:
        raise VehicleError("; ".join(faults))
    return changes


def _read(param: Param, name: str, wished: float) -> tuple[float, bool]:
    """Value, and whether it is an integer: PX4 refuses numbers of the other type, and a mission's 2.0 may be either."""
    getters = [(param.get_param_float, False), (param.get_param_int, True)]
    if float(wished).is_integer():
        getters.reverse()
    with refusals(name):
        for getter, whole in getters:
            try:
                return float(getter(name)), whole
            except ParamError as error:
                if error.result in (ParamResult.DOES_NOT_EXIST, ParamResult.TIMEOUT):
                    raise VehicleError(f"{name}: this vehicle has no such parameter, or does not answer") from error
                if error.result != ParamResult.WRONG_TYPE:
                    raise
    raise VehicleError(f"{name}: is neither an integer nor a float")


def _write(param: Param, name: str, value: float, *, whole: bool) -> None:
    if whole and not float(value).is_integer():
        raise VehicleError(f"{name}: takes whole numbers, not {value:g}")
    with refusals(f"{name} = {value:g}"):
        if whole:
            param.set_param_int(name, int(value))
        else:
            param.set_param_float(name, float(value))
    kept, _ = _read(param, name, value)
    if not math.isclose(kept, value, rel_tol=SAME, abs_tol=SAME):
        raise VehicleError(f"{name}: set to {value:g}, but the vehicle keeps {kept:g}")
