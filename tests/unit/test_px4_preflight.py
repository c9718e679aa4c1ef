"""The checklist, the parameters a mission needs, and when a gimbal counts as lost."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from agents.vehicles.px4.gimbal import Aim, GimbalWatch
from agents.vehicles.px4.parameters import needed_parameters
from agents.vehicles.px4.preflight import Readings, checklist, red
from agents.vehicles.px4.telemetry_slots import Health, Motion, Pointing, Sample, is_jump
from protocol.mission import Drone, Mission
from protocol.vehicle_settings import Parameter, Vehicles

START = (1.0, 2.0, 1.5, 0.0, 1.3)
MISSION = Mission(
    name="checks",
    drones=(Drone(id=3, start=START),),
    vehicles=Vehicles(kind="px4", origin=(47.0, 8.0, 400.0)),
)
HEALTHY = Health(
    gyroscope=True,
    accelerometer=True,
    magnetometer=True,
    local_position=True,
    global_position=True,
    home=True,
    armable=True,
)
AIM = Aim(1.3)
FINE = Readings(
    position=np.array([1.1, 2.0, 0.0]),
    has_attitude=True,
    mode="HOLD",
    landed="ON_GROUND",
    armed=False,
    battery=0.9,
    health=HEALTHY,
    pointing=Pointing(-1.3, 0.0),
)


def faults(readings: Readings, mission: Mission = MISSION, aim: Aim | None = AIM) -> dict[str, str]:
    return {item.name: item.fault for item in red(checklist(readings, mission, 3, aim))}


def test_a_vehicle_that_is_fit_has_no_red_item() -> None:
    assert faults(FINE) == {}
    assert len(checklist(FINE, MISSION, 3, AIM)) == 13


@pytest.mark.parametrize(
    ("change", "item", "reason"),
    [
        ({"position": None}, "telemetry", "position"),
        ({"has_attitude": False}, "telemetry", "attitude"),
        ({"mode": None}, "telemetry", "flight mode"),
        ({"armed": None}, "telemetry", "armed or not"),
        ({"landed": "UNKNOWN"}, "telemetry", "landed or not"),
        ({"health": None}, "health", "not reported"),
        ({"health": replace(HEALTHY, gyroscope=False)}, "gyroscope", "not calibrated"),
        ({"health": replace(HEALTHY, accelerometer=False)}, "accelerometer", "not calibrated"),
        ({"health": replace(HEALTHY, magnetometer=False)}, "magnetometer", "not calibrated"),
        ({"health": replace(HEALTHY, local_position=False)}, "local position", "not estimated"),
        ({"health": replace(HEALTHY, global_position=False)}, "global position", "GPS"),
        ({"health": replace(HEALTHY, home=False)}, "home position", "not set"),
        ({"health": replace(HEALTHY, armable=False)}, "armable", "status texts"),
        ({"armed": True}, "disarmed", "somebody else"),
        ({"battery": None}, "battery", "not reported"),
        ({"battery": 0.2}, "battery", "20% left, must exceed 25%"),
        ({"position": np.array([3.0, 2.0, 0.0])}, "start place", "2.00 m from (1, 2), at most 1 m"),
        ({"position": np.array([1.0, 2.0, 1.6])}, "start height", "stands at 1.60 m"),
        ({"pointing": None}, "gimbal", "not heard"),
        ({"pointing": Pointing(-0.785, 0.0)}, "gimbal", "told to look 74 degrees down, looks 45"),
        ({"undone": {"parameters": "GF_ACTION: no answer"}}, "parameters", "GF_ACTION: no answer"),
    ],
)
def test_every_item_says_by_name_why_it_is_red(change: dict[str, Any], item: str, reason: str) -> None:
    found = faults(replace(FINE, **change))

    assert list(found) == [item]
    assert reason in found[item]


def test_without_an_origin_nobody_asks_for_gps_or_compass() -> None:
    indoors = MISSION.model_copy(update={"vehicles": Vehicles(kind="px4")})
    blind = replace(HEALTHY, magnetometer=False, global_position=False, home=False)

    assert faults(replace(FINE, health=blind), indoors) == {}


def test_a_vehicle_in_the_air_is_not_kept_from_being_taken_over() -> None:
    airborne = replace(
        FINE,
        landed="IN_AIR",
        armed=True,
        battery=0.05,
        position=np.array([9.0, 9.0, 4.0]),
        pointing=None,
        health=replace(HEALTHY, armable=False, magnetometer=False, home=False),
    )

    assert faults(airborne) == {}
    assert list(faults(replace(airborne, health=replace(HEALTHY, local_position=False)))) == ["local position"]


def test_the_parameters_follow_from_the_mission() -> None:
    values = needed_parameters(MISSION, np.array([1.0, 2.0, 0.2]), START[2])

    assert values["COM_OBL_RC_ACT"] == 5
    assert values["MIS_TAKEOFF_ALT"] == pytest.approx(1.3)
    assert values["GF_MAX_HOR_DIST"] == pytest.approx(math.hypot(5.0, 6.0) + 1.0), "the farthest corner and two margins"
    assert values["GF_MAX_VER_DIST"] == pytest.approx(5.0 - 0.2 + 1.0)
    assert values["MPC_XY_VEL_MAX"] >= math.sqrt(2) * MISSION.flight.speed_max_mps
    assert values["MNT_MODE_IN"] == 4


def test_in_the_air_nothing_is_set_that_hangs_on_where_it_started() -> None:
    values = needed_parameters(MISSION, None, START[2])

    assert "COM_OBL_RC_ACT" in values
    assert not {"MIS_TAKEOFF_ALT", "GF_MAX_HOR_DIST", "GF_MAX_VER_DIST"} & set(values)


def test_the_missions_own_parameters_win_and_a_fixed_camera_needs_none_of_a_mount() -> None:
    own = (Parameter(name="COM_OF_LOSS_T", value=0.5), Parameter(name="RTL_RETURN_ALT", value=5))
    vehicles = Vehicles(kind="px4", camera_mount="fixed", parameters=own)

    values = needed_parameters(MISSION.model_copy(update={"vehicles": vehicles}), None, START[2])

    assert (values["COM_OF_LOSS_T"], values["RTL_RETURN_ALT"]) == (0.5, 5)
    assert not any(name.startswith("MNT_") for name in values)


@pytest.mark.parametrize(("pitch", "yaw", "error"), [(-1.3, 0.0, 0.0), (-1.1, 2.0, 0.2), (1.3, 0.0, 2.6)])
def test_a_following_gimbal_is_judged_by_its_depression_alone(pitch: float, yaw: float, error: float) -> None:
    assert AIM.error_rad(Pointing(pitch, yaw)) == pytest.approx(error)


def test_a_locked_gimbal_is_judged_by_its_yaw_too_across_the_wrap() -> None:
    north_west = Aim(1.3, math.radians(179))

    assert north_west.error_rad(Pointing(-1.3, math.radians(-90))) == pytest.approx(math.radians(1))


def judged(watch: GimbalWatch, pitch: float, heard_s: float | None, *times_s: float) -> list[bool]:
    """Whether it was lost at each of these times; ``heard_s`` None: it is heard each time."""
    lost = []
    for now_s in times_s:
        watch.judge(AIM, Sample(Pointing(pitch, 0.0), now_s if heard_s is None else heard_s), now_s)
        lost.append(watch.lost)
    return lost


def test_a_gimbal_is_lost_when_it_is_not_heard_for_long() -> None:
    watch = GimbalWatch(0.35, 1.0)

    assert judged(watch, -1.3, 10.0, 10.0, 10.4, 10.8, 11.0, 11.1) == [False] * 4 + [True]
    assert "not heard" in watch.reason
    assert judged(watch, -1.3, None, 11.2) == [False]


def test_a_gimbal_is_lost_when_it_disobeys_for_long_and_found_when_it_obeys() -> None:
    watch = GimbalWatch(0.35, 1.0)

    assert judged(watch, -0.5, None, 10.0, 10.4, 10.8) == [False] * 3
    assert judged(watch, -1.2, None, 10.9) == [False], "it obeyed for a moment"
    assert judged(watch, -0.5, None, 11.3, 11.7, 11.9, 12.0) == [False] * 3 + [True]
    assert "46 degrees" in watch.reason
    assert judged(watch, -1.3, None, 12.1) == [False]


def test_a_gimbal_is_not_lost_because_this_process_stood_still() -> None:
    watch = GimbalWatch(0.35, 1.0)

    assert judged(watch, -1.3, 10.0, 10.0, 70.0) == [False, False]
    assert judged(watch, -0.5, None, 70.1, 130.0) == [False, False]


def test_others_may_move_the_gimbal_while_they_fly() -> None:
    watch = GimbalWatch(0.35, 2.0)
    for now_s in (10.0, 13.0, 16.0):
        watch.judge(None, Sample(Pointing(0.0, 0.0), now_s), now_s)

    assert not watch.lost


def motion(north: float, at_s: float, speed: float = 0.0) -> Sample[Motion]:
    return Sample(Motion(np.array([north, 0.0, 0.0]), np.array([speed, 0.0, 0.0])), at_s)


def test_an_estimate_that_moves_faster_than_the_vehicle_can_has_jumped() -> None:
    assert not is_jump(motion(0.0, 0.0), motion(0.5, 0.02), 0.9, 0.5)
    assert is_jump(motion(0.0, 0.0), motion(0.6, 0.02), 0.9, 0.5)
    assert not is_jump(motion(0.0, 0.0), motion(2.0, 2.0), 0.9, 0.5), "after a silence it may be elsewhere"
    assert not is_jump(motion(0.0, 0.0, 12.0), motion(1.0, 0.1, 12.0), 0.9, 0.5), "a pilot may fly faster"


def test_before_another_flight_a_vehicle_may_stand_elsewhere_than_at_its_start() -> None:
    away = replace(FINE, position=np.array([9.0, 9.0, 0.0]))
    assert set(faults(away)) == {"start place"}
    again = checklist(away, MISSION, 3, AIM, again=True)
    assert red(again) == []
    assert "start height" in [item.name for item in again]
