"""Who flies: what the vehicle is told on the way into our hands, and whom a mode change is put down to."""

from __future__ import annotations

from dataclasses import replace

import pytest

from agents.vehicles.px4.authority import GAP_MEMORY_S, RETRY_S, STICKS, AuthorityLogic, Observation
from faults.scripted_px4 import AIR, Flight, in_our_hands, on_ground


@pytest.fixture
def ground() -> Flight:
    return on_ground()


@pytest.fixture
def ours() -> Flight:
    return in_our_hands()


def test_from_the_ground_into_our_hands(ground: Flight) -> None:
    assert ground.authority == "ready"
    ground.logic.take_off(ground.now_s)

    assert ground.see() == ["arm"]
    assert ground.authority == "starting"
    assert ground.see(armed=True) == ["take_off"]
    assert ground.see(3.0, mode="TAKEOFF") == []
    assert ground.see(3.0, on_ground=False, height_m=1.2) == []
    assert ground.logic.reason == "taking off: at 1.2 of 1.5 m"
    assert ground.see(1.0, mode="HOLD", height_m=1.4) == ["offboard"]
    assert ground.authority == "starting"
    ground.see(mode="OFFBOARD")
    assert (ground.authority, ground.logic.reason) == ("ours", "")


def test_setpoints_stream_before_offboard_is_asked_for(ground: Flight) -> None:
    ground.logic.take_off(ground.now_s)
    ground.see(armed=True)
    assert ground.logic.streams
    ground.see(mode="TAKEOFF")

    assert ground.see(0.5, mode="HOLD", on_ground=False) == []
    assert ground.logic.streams
    assert ground.see(0.2) == ["offboard"]


@pytest.mark.parametrize("mode", ["LAND", "POSCTL", "OFFBOARD", "READY"])
def test_a_vehicle_left_in_another_mode_is_put_into_hold_before_it_is_armed(ground: Flight, mode: str) -> None:
    ground.see(mode=mode)
    ground.logic.take_off(ground.now_s)

    assert ground.see() == ["hold"]
    assert ground.see(mode="HOLD") == ["arm"]


def test_a_command_without_effect_is_given_again_and_said(ground: Flight) -> None:
    ground.logic.take_off(ground.now_s)

    assert ground.see(2 * RETRY_S + 0.5) == ["arm"] * 3
    assert ground.logic.reason == "arming: arm was acknowledged, but the vehicle stays in HOLD"


def test_a_refusal_is_told_with_the_reason(ground: Flight) -> None:
    ground.logic.take_off(ground.now_s)
    ground.see(answers=False)
    ground.logic.answered("arm", ground.now_s, "arm: command denied")
    ground.see()

    assert ground.logic.reason == "arming: arm: command denied"


def test_nothing_is_commanded_while_a_command_is_on_its_way(ground: Flight) -> None:
    ground.logic.take_off(ground.now_s)

    assert ground.see(5.0, answers=False) == ["arm"]


def test_a_vehicle_in_the_air_is_taken_over_without_a_take_off() -> None:
    flight = Flight(seen=AIR)
    flight.see()
    assert flight.authority == "ready"
    flight.logic.take_off(flight.now_s)

    assert flight.see(1.0) == ["offboard"]
    flight.see(mode="OFFBOARD")
    assert flight.authority == "ours"


@pytest.mark.parametrize("mode", [*STICKS, "LAND", "RETURN_TO_LAUNCH", "MISSION"])
def test_a_vehicle_that_somebody_flies_is_not_snatched(mode: str) -> None:
    flight = Flight(seen=replace(AIR, mode=mode))
    flight.see()
    flight.logic.take_off(flight.now_s)

    assert flight.see(5.0) == []
    assert flight.authority == "yielded"


def test_taking_off_twice_is_taking_off_once(ours: Flight) -> None:
    ours.logic.take_off(ours.now_s)

    assert ours.authority == "ours"


@pytest.mark.parametrize("mode", [*STICKS, "HOLD", "LAND", "RETURN_TO_LAUNCH", "MISSION"])
def test_a_mode_change_from_outside_is_a_take_over(ours: Flight, mode: str) -> None:
    assert ours.see(10.0, sends=True, mode=mode) == []

    assert ours.authority == "yielded"
    assert mode in ours.logic.reason
    assert ours.logic.streams, "without setpoints PX4 would not let the pilot give it back"
    assert not ours.logic.sent(ours.now_s)


def test_a_pilot_gives_it_back_by_switching_to_offboard(ours: Flight) -> None:
    ours.see(60.0, mode="POSCTL")
    assert ours.see(mode="OFFBOARD") == []
    assert ours.authority == "ours"

    ours.see(0.1, sends=True)
    ours.see(mode="HOLD")
    assert ours.authority == "yielded", "the silence while the pilot flew is no gap of ours"


@pytest.mark.parametrize("mode", STICKS)
def test_a_pilot_may_take_over_during_the_take_off(ground: Flight, mode: str) -> None:
    ground.logic.take_off(ground.now_s)
    ground.see(armed=True)
    ground.see(1.0, mode="TAKEOFF", on_ground=False)

    assert ground.see(5.0, mode=mode) == []
    assert ground.authority == "yielded"


def test_a_failsafe_after_a_gap_of_ours_is_not_a_take_over(ours: Flight) -> None:
    ours.now_s += 1.5  # nothing ran
    ours.logic.sent(ours.now_s)
    ours.see(mode="HOLD", sends=True)

    assert ours.authority == "starting"
    assert "gap of 1.5 s" in ours.logic.reason
    assert ours.see(1.0) == ["offboard"]
    ours.see(mode="OFFBOARD")
    assert ours.authority == "ours"


def test_a_gap_is_seen_before_the_control_task_has_sent_again(ours: Flight) -> None:
    ours.now_s += 1.5
    ours.see(mode="HOLD")

    assert ours.authority == "starting"


def test_a_link_that_was_silent_made_the_vehicle_hold(ours: Flight) -> None:
    ours.see(1.5, sends=True, silent=True)
    ours.see(sends=True, mode="HOLD")

    assert ours.authority == "starting"


@pytest.mark.parametrize("mode", [*STICKS, "LAND", "RETURN_TO_LAUNCH"])
def test_sticks_win_even_right_after_a_gap(ours: Flight, mode: str) -> None:
    ours.now_s += 1.5
    ours.logic.sent(ours.now_s)
    ours.see(mode=mode, sends=True)

    assert ours.authority == "yielded"


def test_a_gap_of_long_ago_excuses_nothing(ours: Flight) -> None:
    ours.now_s += 1.5
    ours.logic.sent(ours.now_s)
    ours.see(GAP_MEMORY_S + 0.2, sends=True)
    ours.see(mode="HOLD", sends=True)

    assert ours.authority == "yielded"


def test_a_loss_action_that_looks_like_a_pilot_is_taken_for_one() -> None:
    flight = Flight(AuthorityLogic(1.5, 3.0, failsafe=""), seen=AIR)
    flight.see()
    flight.logic.take_off(flight.now_s)
    flight.see(1.0)
    flight.see(mode="OFFBOARD")
    flight.now_s += 2.0
    flight.see(mode="HOLD")

    assert flight.authority == "yielded"


def test_old_news_of_the_mode_before_the_take_off_does_not_end_it() -> None:
    logic = AuthorityLogic(start_m=1.5, lost_after_s=3.0)

    def seen(mode: str, height_m: float, *, now_s: float, on_ground: bool = False) -> None:
        logic.observe(
            Observation(
                mode=mode,
                mode_at_s=now_s,
                armed=True,
                on_ground=on_ground,
                height_m=height_m,
                heard_s=now_s,
            ),
            now_s,
        )

    seen("HOLD", 0.0, now_s=0.0, on_ground=True)
    logic.take_off(0.1)
    seen("HOLD", 0.2, now_s=0.2)
    assert logic.phase == "climbing", "it has left the ground before a heartbeat told of TAKEOFF"
    seen("TAKEOFF", 0.4, now_s=1.2)
    seen("HOLD", 1.3, now_s=2.2)
    assert logic.phase == "entering"


def test_a_landed_vehicle_with_another_battery_takes_off_as_at_first(ours: Flight) -> None:
    assert not ours.logic.make_ready(ours.now_s), "it flies"
    ours.logic.land(direct=False)
    ours.see(1.0, mode="LAND")
    ours.see(on_ground=True, height_m=0.0)
    assert not ours.logic.make_ready(ours.now_s), "it is armed"
    ours.see(armed=False, mode="HOLD")
    assert ours.authority == "landed"

    assert ours.logic.make_ready(ours.now_s)
    assert ours.authority == "ready"
    assert ours.see() == [], "nobody ordered anything"
    ours.logic.take_off(ours.now_s)
    assert ours.see() == ["arm"]
    assert ours.see(armed=True) == ["take_off"]
    ours.see(3.0, mode="TAKEOFF")
    ours.see(mode="TAKEOFF", on_ground=False, height_m=1.4)
    assert ours.see(1.0, mode="HOLD") == ["offboard"]
    ours.see(mode="OFFBOARD")
    assert ours.authority == "ours"


def test_a_vehicle_that_falls_silent_on_the_ground_may_have_been_switched_off(ours: Flight) -> None:
    ours.see(4.0, silent=True, sends=True)
    assert ours.authority == "lost"
    assert ours.logic.silences == 0, "in the air it has not"
    ours.see(mode="OFFBOARD", sends=True)
    ours.logic.land(direct=False)
    ours.see(1.0, mode="LAND")
    ours.see(on_ground=True, height_m=0.0, armed=False, mode="HOLD")
    assert ours.authority == "landed"
    for count in (1, 2):
        ours.see(4.0, silent=True)
        assert ours.logic.silences == count, "once for each silence"
        assert ours.authority == "landed", "it stands where it stood"
        ours.see(1.0)
    assert ours.logic.make_ready(ours.now_s)
