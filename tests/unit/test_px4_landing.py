"""Out of our hands: holding, landing, and a vehicle that is not heard."""

from __future__ import annotations

import pytest

from agents.vehicles.px4.authority import DISARM_S, RETRY_S
from faults.scripted_px4 import Flight, in_our_hands, on_ground


@pytest.fixture
def ground() -> Flight:
    return on_ground()


@pytest.fixture
def ours() -> Flight:
    return in_our_hands()


def test_a_hold_of_ours_lasts_until_the_control_task_sends_again(ours: Flight) -> None:
    assert ours.logic.hold(direct=True)
    assert ours.see(0.5) == [], "OFFBOARD told before the answer is old"
    ours.logic.answered("hold", ours.now_s)
    assert ours.see(10.0, mode="HOLD") == []
    assert ours.authority == "ours", "else the control task would not send"
    assert not ours.logic.hold(direct=True), "it holds already"

    assert not ours.logic.sent(ours.now_s), "not before it is in OFFBOARD again"
    assert ours.authority == "starting"
    assert ours.see(1.0) == ["offboard"]
    ours.see(mode="OFFBOARD")
    assert ours.authority == "ours"
    assert ours.logic.sent(ours.now_s)


def test_a_hold_without_effect_is_repeated(ours: Flight) -> None:
    ours.logic.hold(direct=True)
    ours.logic.answered("hold", ours.now_s, "hold: timeout")

    assert ours.see(2 * RETRY_S + 0.5) == ["hold", "hold"]


def test_an_old_offboard_is_not_taken_for_a_new_one(ours: Flight) -> None:
    ours.logic.hold(direct=True)
    ours.logic.answered("hold", ours.now_s + 0.5)
    ours.logic.sent(ours.now_s)
    ours.see(0.4)

    assert ours.authority == "starting"


def test_sticks_win_over_a_hold(ours: Flight) -> None:
    ours.logic.hold(direct=True)
    ours.logic.answered("hold", ours.now_s)
    ours.see(mode="HOLD")
    ours.see(mode="POSCTL")

    assert ours.authority == "yielded"


@pytest.mark.parametrize("mode", ["POSCTL", "HOLD"])
def test_a_watchdog_leaves_a_pilots_vehicle_alone(ours: Flight, mode: str) -> None:
    ours.see(mode=mode)

    assert not ours.logic.hold(direct=True)
    assert not ours.logic.land(direct=True)
    assert ours.see(5.0) == []


def test_a_vehicle_on_the_ground_is_not_held(ground: Flight) -> None:
    assert not ground.logic.hold(direct=True)
    ground.logic.take_off(ground.now_s)
    assert not ground.logic.hold(direct=True)
    assert ground.see() == ["arm"]


def test_it_lands_and_stays_down(ours: Flight) -> None:
    assert ours.logic.land(direct=True)
    ours.logic.answered("land", ours.now_s)
    assert ours.see(5.0, mode="LAND", sends=True) == []
    assert ours.authority == "landing"
    assert ours.see(1.0, on_ground=True) == []
    ours.see(armed=False, mode="OFFBOARD")

    assert ours.authority == "landed"
    assert not ours.logic.sent(ours.now_s)
    assert not ours.logic.land(direct=True)
    ours.logic.take_off(ours.now_s)
    assert ours.see(5.0) == []
    assert ours.authority == "landed"


def test_a_landing_without_effect_is_repeated_and_needs_no_caller(ours: Flight) -> None:
    assert ours.logic.land(direct=False)

    assert ours.see(2 * RETRY_S + 0.5) == ["land"] * 3


def test_a_landing_is_repeated_into_the_silence(ours: Flight) -> None:
    ours.see(4.0, silent=True)
    assert ours.authority == "lost"
    ours.logic.land(direct=False)

    assert ours.see(RETRY_S + 0.5, silent=True) == ["land"] * 2
    ours.see(mode="LAND")
    assert ours.authority == "landing"


def test_a_vehicle_that_does_not_disarm_after_landing_is_told_to(ours: Flight) -> None:
    ours.logic.land(direct=False)
    ours.see()
    ours.see(1.0, mode="LAND")

    assert ours.see(DISARM_S + 0.2, on_ground=True) == ["disarm"]


def test_a_pilot_may_take_over_a_landing_and_it_goes_on_when_given_back(ours: Flight) -> None:
    ours.logic.land(direct=False)
    ours.see()
    ours.see(1.0, mode="LAND")
    assert ours.see(3.0, mode="POSCTL") == []
    assert ours.authority == "yielded"

    assert ours.see(mode="OFFBOARD") == ["land"]
    assert ours.authority == "landing"


def test_told_to_land_before_it_took_off_it_stays_where_it_is(ground: Flight) -> None:
    assert not ground.logic.land(direct=True)
    ground.see()

    assert ground.authority == "landed"


def test_told_to_land_while_it_spools_up_it_is_disarmed(ground: Flight) -> None:
    ground.logic.take_off(ground.now_s)
    ground.see(armed=True)
    ground.logic.land(direct=False)

    assert ground.see() == ["disarm"]
    ground.see(armed=False)
    assert ground.authority == "landed"


def test_a_pilot_who_lands_it_ends_the_flight(ours: Flight) -> None:
    ours.see(mode="POSCTL")
    ours.see(on_ground=True)
    ours.see(armed=False)

    assert ours.authority == "landed"


def test_a_vehicle_that_is_not_heard_is_lost_until_it_is_heard(ours: Flight) -> None:
    ours.see(2.9, silent=True)
    assert ours.authority == "ours"
    ours.see(0.3, silent=True)
    assert (ours.authority, ours.logic.reason) == ("lost", "nothing heard for 3.2 s")
    ours.see()
    assert ours.authority == "ours"


def test_a_vehicle_without_heartbeats_is_lost_sooner_but_not_while_anything_else_is_heard(ours: Flight) -> None:
    ours.see(2.0, connected=False)
    assert ours.authority == "ours"
    ours.see(1.1, silent=True)
    assert ours.authority == "lost"


def test_a_vehicle_is_not_lost_because_this_process_stood_still(ours: Flight) -> None:
    ours.now_s += 60.0
    ours.see(silent=True, connected=False)

    assert ours.authority == "ours"
