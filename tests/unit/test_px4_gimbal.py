"""The endpoint's gimbal obeys who is in control, no faster than it can, and follows or keeps the heading as told."""

from __future__ import annotations

import math

import pytest

from sim_bridge.px4_endpoint.dialect import mavlink
from sim_bridge.px4_endpoint.gimbal import RELEASE, SELF, Gimbal
from sim_bridge.px4_endpoint.parameters import Parameters

DT = 0.01
RATE_MAX = 2.0
ME, OTHER = (245, 190), (255, 190)
FOLLOW = 0
LOCK: int = mavlink.GIMBAL_MANAGER_FLAGS_YAW_LOCK
NAN = math.nan


def gimbal(*, taken: bool = True) -> Gimbal:
    parameters = Parameters()
    parameters.set("MNT_RANGE_PITCH", 180.0)
    new = Gimbal(parameters, RATE_MAX)
    if taken:
        new.configure(ME, ME)
    return new


def run(of: Gimbal, seconds: float, vehicle_yaw: float = 0.0) -> None:
    for _ in range(round(seconds / DT)):
        of.step(vehicle_yaw, DT)


def test_nobody_is_obeyed_before_control_is_taken() -> None:
    new = gimbal(taken=False)
    assert not new.aim(ME, FOLLOW, -1.0, 0.0, NAN, NAN)
    new.configure((SELF, SELF), ME)
    assert new.aim(ME, FOLLOW, -1.0, 0.0, NAN, NAN)
    assert not new.aim(OTHER, FOLLOW, -0.5, 0.0, NAN, NAN)


def test_control_is_released_only_by_who_has_it() -> None:
    new = gimbal()
    new.configure((RELEASE, RELEASE), OTHER)
    assert new.controller == ME
    new.configure((RELEASE, RELEASE), ME)
    assert new.controller == (0, 0)


def test_it_gets_where_it_is_told() -> None:
    new = gimbal()
    new.aim(ME, FOLLOW, -1.2, 0.7, NAN, NAN)
    run(new, 2.0)
    assert (new.pitch.angle, new.yaw.angle) == pytest.approx((-1.2, 0.7), abs=1e-3)


def test_it_slews_no_faster_than_it_can() -> None:
    new = gimbal()
    new.aim(ME, FOLLOW, -1.5, 0.0, NAN, NAN)
    fastest, before = 0.0, 0.0
    for _ in range(100):
        new.step(0.0, DT)
        fastest, before = max(fastest, abs(new.pitch.angle - before) / DT), new.pitch.angle
    assert fastest == pytest.approx(RATE_MAX, rel=0.02)


def test_it_keeps_to_its_range() -> None:
    new = Gimbal(Parameters(), RATE_MAX)  # PX4's default: 45 degrees either way
    new.configure(ME, ME)
    new.aim(ME, FOLLOW, -math.pi / 2, 0.0, NAN, NAN)
    run(new, 3.0)
    assert new.pitch.angle == pytest.approx(-math.pi / 4, abs=1e-3)


def test_rates_move_it_evenly() -> None:
    new = gimbal()
    new.aim(ME, FOLLOW, NAN, NAN, -0.2, 0.1)
    run(new, 3.0)
    assert (new.pitch.angle, new.yaw.angle) == pytest.approx((-0.6, 0.3), abs=0.02)


def test_following_it_turns_with_the_vehicle_and_locked_it_does_not() -> None:
    new = gimbal()
    new.aim(ME, FOLLOW, 0.0, 0.3, NAN, NAN)
    run(new, 2.0, vehicle_yaw=1.0)
    assert new.yaw.angle == pytest.approx(0.3, abs=1e-3)
    new.aim(ME, LOCK, 0.0, 0.3, NAN, NAN)
    run(new, 2.0, vehicle_yaw=1.0)
    assert new.yaw.angle + 1.0 == pytest.approx(0.3, abs=1e-3)


def test_a_stuck_one_stays_where_it_is_until_freed() -> None:
    new = gimbal()
    new.aim(ME, FOLLOW, -1.0, 0.0, NAN, NAN)
    run(new, 0.2)
    new.stuck = True
    here = new.pitch.angle
    run(new, 1.0)
    assert new.pitch.angle == here
    new.stuck = False
    run(new, 2.0)
    assert new.pitch.angle == pytest.approx(-1.0, abs=1e-3)
