"""When the endpoint's vehicle arms, changes its mode, or has it changed by a failsafe: PX4's rules."""

from __future__ import annotations

from dataclasses import replace

import pytest

from sim_bridge.px4_endpoint.commander import Commander, Situation
from sim_bridge.px4_endpoint.modes import ARMED, Mode, base_mode, mode_of
from sim_bridge.px4_endpoint.parameters import Parameters

GROUND = Situation(now_s=10.0, stream=False, landed=True)
AIR = Situation(now_s=20.0, stream=True, landed=False)


def commander(**parameters: float) -> Commander:
    values = Parameters()
    for name, value in parameters.items():
        values.set(name, value)
    return Commander(values)


def flying(mode: Mode = Mode.OFFBOARD, **parameters: float) -> Commander:
    new = commander(**parameters)
    assert new.arm(GROUND)
    new.step(AIR)
    assert new.command(mode, AIR)
    new.texts.clear()
    return new


def texts(of: Commander) -> str:
    return "\n".join(text for _, text in of.texts)


def test_modes_are_written_as_px4_writes_them() -> None:
    assert Mode.OFFBOARD == 6 << 16
    assert Mode.HOLD == 4 << 16 | 3 << 24
    assert mode_of(4, 6) is Mode.LAND
    assert mode_of(6, 0) is Mode.OFFBOARD
    assert mode_of(99, 0) is None
    assert base_mode(Mode.HOLD, armed=True) - base_mode(Mode.HOLD, armed=False) == ARMED


def test_it_arms_when_all_is_well_and_not_with_a_red_check() -> None:
    well, ill = commander(), commander()
    assert well.arm(GROUND)
    assert not ill.arm(replace(GROUND, faults=("gps",)))
    assert not ill.armed
    assert "Resolve system health failures first" in texts(ill)
    assert "gps" in texts(ill)


def test_it_can_be_told_to_refuse_arming() -> None:
    new = commander()
    new.deny_arming = True
    assert not new.arm(GROUND)
    assert texts(new)


def test_offboard_is_taken_on_the_ground_but_arms_only_with_setpoints() -> None:
    new = commander()
    assert new.command(Mode.OFFBOARD, GROUND)
    assert new.mode is Mode.OFFBOARD
    assert not new.arm(GROUND)
    assert new.arm(replace(GROUND, stream=True))


def test_offboard_in_the_air_without_setpoints_leaves_the_mode_and_says_so() -> None:
    new = flying(Mode.HOLD)
    assert not new.command(Mode.OFFBOARD, replace(AIR, stream=False))
    assert new.mode is Mode.HOLD
    assert "Switching to Offboard" in texts(new)


def test_offboard_can_be_refused_in_spite_of_setpoints() -> None:
    new = flying(Mode.HOLD)
    new.refuse_offboard = True
    assert not new.command(Mode.OFFBOARD, AIR)
    new.refuse_offboard = False
    assert new.command(Mode.OFFBOARD, AIR)


@pytest.mark.parametrize(
    ("action", "mode"), [(0, Mode.POSCTL), (1, Mode.POSCTL), (3, Mode.RTL), (4, Mode.LAND), (5, Mode.HOLD)]
)
def test_when_setpoints_stop_it_does_what_the_parameter_says(action: int, mode: Mode) -> None:
    new = flying(COM_OBL_RC_ACT=action)
    new.step(replace(AIR, stream=False))
    assert new.mode is mode
    assert "Failsafe activated" in texts(new)


def test_the_failsafe_is_told_once_and_ends_when_setpoints_come_back() -> None:
    new = flying(COM_OBL_RC_ACT=5)
    for _ in range(3):
        new.step(replace(AIR, stream=False))
    assert len(new.texts) == 1
    new.step(AIR)
    assert new.mode is Mode.OFFBOARD


def test_another_mode_commanded_during_the_failsafe_stays_when_setpoints_come_back() -> None:
    new = flying(COM_OBL_RC_ACT=5)
    new.step(replace(AIR, stream=False))
    assert new.command(Mode.LAND, replace(AIR, stream=False))
    new.step(AIR)
    assert new.mode is Mode.LAND


def test_take_off_ends_in_hold() -> None:
    new = flying(Mode.TAKEOFF)
    modes = []
    for took_off in (False, True):
        new.step(replace(AIR, took_off=took_off))
        modes.append(new.mode)
    assert modes == [Mode.TAKEOFF, Mode.HOLD]


def test_it_does_not_disarm_in_the_air_unless_forced() -> None:
    new = flying()
    assert not new.disarm(AIR)
    assert new.armed
    assert "not landed" in texts(new)
    assert new.disarm(AIR, forced=True)
    assert not new.armed


def test_after_a_landing_it_disarms_and_goes_back_to_the_mode_before() -> None:
    new = flying(Mode.OFFBOARD, COM_DISARM_LAND=2.0)
    assert new.command(Mode.LAND, AIR)
    new.step(AIR)
    new.step(replace(AIR, landed=True, now_s=30.0))
    new.step(replace(AIR, landed=True, now_s=31.9))
    assert new.armed
    new.step(replace(AIR, landed=True, now_s=32.1))
    assert not new.armed
    assert new.mode is Mode.OFFBOARD


def test_armed_and_left_alone_on_the_ground_it_disarms() -> None:
    new = commander(COM_DISARM_PRFLT=10.0)
    new.arm(GROUND)
    new.step(GROUND)
    new.step(replace(GROUND, now_s=19.9))
    assert new.armed
    new.step(replace(GROUND, now_s=20.1))
    assert not new.armed


def test_it_does_not_arm_to_land() -> None:
    new = commander()
    new.command(Mode.LAND, GROUND)
    assert not new.arm(GROUND)


@pytest.mark.parametrize(("action", "mode"), [(1, Mode.OFFBOARD), (2, Mode.HOLD), (3, Mode.RTL), (5, Mode.LAND)])
def test_outside_the_fence_it_does_what_the_parameter_says_until_told_otherwise(action: int, mode: Mode) -> None:
    new = flying(GF_ACTION=action)
    new.step(replace(AIR, outside_fence=True))
    assert new.mode is mode
    assert "Geofence" in texts(new)
    new.step(AIR)
    assert new.mode is mode
    assert new.command(Mode.OFFBOARD, AIR)
    new.step(AIR)
    assert new.mode is Mode.OFFBOARD


@pytest.mark.parametrize(("action", "mode"), [(0, Mode.OFFBOARD), (2, Mode.LAND), (3, Mode.RTL)])
def test_a_battery_that_runs_out_is_told_and_then_acted_upon(action: int, mode: Mode) -> None:
    new = flying(COM_LOW_BAT_ACT=action)
    new.step(replace(AIR, battery=0.12))
    assert "Low battery" in texts(new)
    assert new.mode is Mode.OFFBOARD
    new.step(replace(AIR, battery=0.06))
    assert "Critical battery" in texts(new)
    assert new.mode is mode
