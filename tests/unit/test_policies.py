"""What a drone does when it cannot go on as planned: every row of the table, who wins, and what lasts."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import pytest

from agents.policies import (
    ESTIMATE_STEADY_S,
    POLICIES,
    SEVERITY,
    Action,
    Order,
    Policies,
    Situation,
    outside_m,
    policy_table,
)
from agents.vehicles.vehicle import Authority
from protocol.mission import Drone, Flight, Mission, Replication
from protocol.vehicle_settings import Vehicles

MISSION = Mission(
    drones=(Drone(id=1, start=(0.0, 0.0, 2.0, 0.0, 1.3)),),
    vehicles=Vehicles(
        telemetry_stale_s=0.5,
        telemetry_lost_s=3.0,
        battery_low=0.25,
        battery_critical=0.1,
        fence_margin_m=0.5,
        at_end="return",
        takeoff_s=60.0,
    ),
    replication=Replication(ground_patience_s=60.0, ground_lost="hold"),
)
FINE = Situation("ours")
BIT = 1e-6

IN_FLIGHT: dict[str, tuple[dict[str, Any], dict[str, Any], Action]] = {
    "telemetry lost": ({"telemetry_age_s": 3.0 + BIT}, {"telemetry_age_s": 0.5}, "land"),
    "operator: land": ({"operator": "land"}, {"operator": "fly"}, "land"),
    "battery critical": ({"battery": 0.1}, {"battery": 0.25 + BIT}, "land"),
    "geofence": ({"outside_m": 0.5 + BIT}, {"outside_m": 0.5}, "land"),
    "position lost": ({"unsure_s": 5.0 + BIT}, {"unsure_s": 5.0}, "land"),
    "mission end": ({"finished": "J fell below 0.5"}, {"finished": ""}, "return"),
    "operator: return": ({"operator": "return"}, {"operator": "fly"}, "return"),
    "battery low": ({"battery": 0.25}, {"battery": 0.25 + BIT}, "return"),
    "battery reserve": ({"reserve": 1.0}, {"reserve": 1.0 - BIT}, "return"),
    "gimbal lost": ({"gimbal_lost": True}, {"gimbal_lost": False}, "return"),
    "ground station lost": ({"ground_away_s": 60.0 + BIT}, {"ground_away_s": 60.0}, "hold"),
    "obstacle map stale": ({"map_age_s": 5.0 + BIT}, {"map_age_s": 5.0}, "hold"),
    "operator: pause": ({"operator": "hold"}, {"operator": "fly"}, "hold"),
    "telemetry stale": ({"telemetry_age_s": 0.5 + BIT}, {"telemetry_age_s": 0.5}, "hold"),
    "estimate jumped": (
        {"jump_age_s": ESTIMATE_STEADY_S - BIT},
        {"jump_age_s": ESTIMATE_STEADY_S},
        "hold",
    ),
    "position unsure": ({"position_sd_m": 0.2 + BIT}, {"position_sd_m": 0.2}, "hold"),
}
"""What makes a row hold, what nearly does, and its order; the upper row is named when two order the same."""
FOR_GOOD = {
    "telemetry lost",
    "operator: land",
    "battery critical",
    "geofence",
    "position lost",
    "mission end",
    "operator: return",
    "battery low",
    "battery reserve",
    "gimbal lost",
}
OPERATORS = {"operator: land", "operator: return", "operator: pause"}
BLIND = {"telemetry stale", "estimate jumped", "position unsure"}
BY_AUTHORITY: dict[Authority, tuple[str, Action]] = {
    "ready": ("not ours yet", "wait"),
    "starting": ("not ours yet", "wait"),
    "yielded": ("take-over", "yield"),
    "landing": ("landing", "land"),
    "landed": ("landing", "land"),
    "lost": ("telemetry lost", "land"),
}


def bad(*names: str, authority: Authority = "ours") -> Situation:
    """Where the conditions of all these rows hold."""
    # An older telemetry and an emptier battery are also what the milder row asks for.
    changes = [IN_FLIGHT[name][0] for name in sorted(names, key=list(IN_FLIGHT).index, reverse=True)]
    return Situation(authority, **{key: value for change in changes for key, value in change.items()})


def mission(**changes: str) -> Mission:
    vehicles = MISSION.vehicles.model_copy(update={k: v for k, v in changes.items() if k == "at_end"})
    replication = MISSION.replication.model_copy(update={k: v for k, v in changes.items() if k == "ground_lost"})
    return MISSION.model_copy(update={"vehicles": vehicles, "replication": replication})


def test_a_drone_that_is_well_flies_as_planned() -> None:
    assert Policies(MISSION).decide(FINE) == Order("fly", "as planned", "")


# --- every row -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", IN_FLIGHT)
def test_a_row_orders_what_the_table_says_and_not_before_its_limit(name: str) -> None:
    _, nearly, action = IN_FLIGHT[name]
    policies = Policies(MISSION)

    assert policies.decide(replace(FINE, **nearly)) == Order("fly")
    order = policies.decide(bad(name))
    assert (order.action, order.policy) == (action, name)


@pytest.mark.parametrize("authority", BY_AUTHORITY)
def test_who_flies_decides_alone_what_may_be_ordered(authority: Authority) -> None:
    order = Policies(MISSION).decide(Situation(authority))

    assert (order.policy, order.action) == BY_AUTHORITY[authority]


@pytest.mark.parametrize(
    ("situation", "reason"),
    [
        (Situation("yielded", "pilot switched to POSCTL"), "pilot switched to POSCTL"),
        (Situation("yielded"), "somebody else flies"),
        (Situation("starting", "OFFBOARD refused 3 times"), "OFFBOARD refused 3 times"),
        (Situation("ready"), "ready"),
        (Situation("landing", "told by the pilot"), "told by the pilot"),
        (Situation("landed"), "landed"),
        (Situation("lost", telemetry_age_s=0.7), "telemetry 0.7 s old"),
        (bad("telemetry stale"), "telemetry 0.5 s old"),
        (bad("battery critical"), "battery at 10%"),
        (bad("battery low"), "battery at 25%"),
        (Situation("ours", battery=0.4, reserve=0.42), "battery at 40%, the way home is kept 42%"),
        (bad("geofence"), "0.50 m outside the flight region"),
        (bad("mission end"), "J fell below 0.5"),
        (bad("gimbal lost"), "the gimbal does not obey"),
        (bad("ground station lost"), "no ground station for 60 s"),
        (bad("estimate jumped"), "the position estimate jumped"),
        (bad("obstacle map stale"), "no map of free cells"),
    ],
)
def test_an_order_says_why(situation: Situation, reason: str) -> None:
    assert Policies(MISSION).decide(situation).reason == reason


@pytest.mark.parametrize("action", ["return", "land", "hold"])
def test_the_mission_says_what_is_done_at_its_end(action: Action) -> None:
    assert Policies(mission(at_end=action)).decide(bad("mission end")).action == action


@pytest.mark.parametrize("action", ["land", "hold"])
def test_the_mission_says_what_is_done_without_a_ground_station(action: Action) -> None:
    assert Policies(mission(ground_lost=action)).decide(bad("ground station lost")).action == action


# --- who wins --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("upper", "lower"), list(itertools.combinations(IN_FLIGHT, 2)))
def test_of_two_rows_the_more_severe_wins_but_nobody_returns_blind(upper: str, lower: str) -> None:
    order = Policies(MISSION).decide(bad(upper, lower))

    blind_return = IN_FLIGHT[upper][2] == "return" and lower in BLIND
    assert order.policy == (lower if blind_return else upper)
    assert order.action == IN_FLIGHT[order.policy][2]


@pytest.mark.parametrize("authority", ["yielded", "landing", "landed"])
@pytest.mark.parametrize("name", IN_FLIGHT)
def test_no_row_overrules_a_pilot_or_a_landing(name: str, authority: Authority) -> None:
    order = Policies(MISSION).decide(bad(name, authority=authority))

    assert (order.policy, order.action) == BY_AUTHORITY[authority]


def test_telemetry_is_stale_before_it_is_lost() -> None:
    ages = (0.5, 0.5 + BIT, 3.0, 3.0 + BIT)

    orders = [Policies(MISSION).decide(replace(FINE, telemetry_age_s=age)).policy for age in ages]

    assert orders == ["as planned", "telemetry stale", "telemetry stale", "telemetry lost"]


def test_the_milder_row_is_carried_out_where_the_mission_makes_it_the_more_severe() -> None:
    policies = Policies(mission(at_end="hold", ground_lost="land"))

    assert policies.decide(bad("mission end", "ground station lost")).policy == "ground station lost"
    assert policies.decide(bad("mission end", "battery low")).policy == "battery low"


# --- before it is ours -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["battery critical", "battery low", "mission end"])
@pytest.mark.parametrize("at_end", ["return", "hold"])
def test_a_drone_on_the_ground_that_may_not_fly_stays_there(name: str, at_end: str) -> None:
    order = Policies(mission(at_end=at_end)).decide(bad(name, authority="ready"))

    assert (order.action, order.policy) == ("land", name)


def test_a_paused_drone_on_the_ground_takes_off_when_it_may() -> None:
    policies = Policies(MISSION)
    assert policies.decide(bad("operator: pause", authority="ready")).action == "land"
    assert policies.decide(Situation("ready")).action == "wait"


@pytest.mark.parametrize("name", ["telemetry lost", "battery critical"])
def test_a_drone_that_takes_off_comes_down_for_what_cannot_wait(name: str) -> None:
    order = Policies(MISSION).decide(bad(name, authority="starting"))

    assert (order.action, order.policy) == ("land", name)


@pytest.mark.parametrize("name", ["battery low", "mission end"])
def test_a_return_waits_until_the_vehicle_obeys_and_lands_when_it_never_does(name: str) -> None:
    situation = bad(name, authority="starting")
    policies = Policies(MISSION)

    assert policies.decide(replace(situation, starting_s=60.0)).action == "wait"
    assert policies.decide(replace(situation, starting_s=60.0 + BIT)).action == "land"
    assert policies.decide(replace(situation, authority="ours")).action == "return"


def test_a_hold_waits_for_as_long_as_the_vehicle_does_not_obey() -> None:
    order = Policies(mission(at_end="hold")).decide(replace(bad("mission end", authority="starting"), starting_s=1e3))

    assert order == Order("wait", "mission end", "J fell below 0.5")


@pytest.mark.parametrize(
    "name",
    sorted(set(IN_FLIGHT) - {"telemetry lost", "battery critical", "battery low", "mission end"} - OPERATORS),
)
@pytest.mark.parametrize("authority", ["ready", "starting"])
def test_the_other_rows_wait_until_the_drone_is_ours(name: str, authority: Authority) -> None:
    assert Policies(MISSION).decide(bad(name, authority=authority)).policy == "not ours yet"


def test_a_vehicle_that_is_silent_before_it_ever_flew_is_not_told_to_land_for_good() -> None:
    policies = Policies(MISSION)
    assert policies.decide(Situation("ready", telemetry_age_s=9.0)).action == "wait"
    assert policies.decide(Situation("lost", telemetry_age_s=9.0)).action == "land"

    assert policies.decide(Situation("ready")).action == "wait"
    assert policies.decide(FINE).action == "fly"


# --- what lasts ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", IN_FLIGHT)
def test_what_was_begun_for_good_goes_on_and_all_else_ends_with_its_cause(name: str) -> None:
    policies = Policies(MISSION)
    begun = policies.decide(bad(name))

    assert policies.decide(FINE) == (begun if name in FOR_GOOD else Order("fly"))


@pytest.mark.parametrize("name", sorted(FOR_GOOD))
def test_a_pilot_who_gives_the_drone_back_does_not_undo_it(name: str) -> None:
    policies = Policies(MISSION)
    begun = policies.decide(bad(name))

    assert policies.decide(Situation("yielded")).action == "yield"
    assert policies.decide(FINE) == begun


@pytest.mark.parametrize("name", IN_FLIGHT)
def test_what_happens_in_a_pilots_hands_is_not_held_against_the_drone(name: str) -> None:
    policies = Policies(MISSION)
    policies.decide(bad(name, authority="yielded"))

    assert policies.decide(FINE) == Order("fly")


def test_a_landing_stays_one_though_a_pilot_stops_it_and_gives_back() -> None:
    policies = Policies(MISSION)
    for authority in ("landing", "yielded"):
        policies.decide(Situation(authority))

    assert policies.decide(FINE).action == "land"


def test_a_return_waits_for_the_estimate_and_goes_on() -> None:
    policies = Policies(MISSION)
    policies.decide(bad("battery low"))

    assert policies.decide(replace(FINE, jump_age_s=0.0)).action == "hold"
    assert policies.decide(replace(FINE, telemetry_age_s=1.0)).action == "hold"
    assert policies.decide(FINE) == Order("return", "battery low", "battery at 25%")


def test_a_return_becomes_a_landing_when_it_gets_worse_and_never_a_return_again() -> None:
    policies = Policies(MISSION)

    orders = [policies.decide(replace(FINE, battery=share)).policy for share in (0.3, 0.2, 0.3, 0.1, 0.2, 0.9)]

    assert orders == ["as planned", "battery low", "battery low", *["battery critical"] * 3]


def test_every_jump_starts_the_wait_anew() -> None:
    policies = Policies(MISSION)

    ages = (math.inf, 0.0, 1.9, 0.1, 1.9, ESTIMATE_STEADY_S)

    assert [policies.decide(replace(FINE, jump_age_s=age)).action for age in ages] == ["fly", *["hold"] * 4, "fly"]


def test_a_reason_stays_while_its_row_holds_and_is_told_anew_the_next_time() -> None:
    policies = Policies(MISSION)

    reasons = [policies.decide(replace(FINE, telemetry_age_s=age)).reason for age in (0.6, 0.8, 0.1, 0.9)]

    assert reasons == ["telemetry 0.6 s old", "telemetry 0.6 s old", "", "telemetry 0.9 s old"]


# --- the table -------------------------------------------------------------------------------------------------------


def test_the_documents_table_has_every_row_and_names_settings_that_exist() -> None:
    table = policy_table()

    assert [row[0] for row in table] == [policy.name for policy in POLICIES]
    assert {row[0] for row in table} == {*IN_FLIGHT, *(name for name, _ in BY_AUTHORITY.values())}
    assert {row[0] for row in table if row[3] == "for good"} == FOR_GOOD | {"landing"}
    for text in itertools.chain.from_iterable(table):
        for setting in text.split("`")[1::2]:
            section, _, key = setting.partition(".")
            assert key in getattr(MISSION, section).model_dump(), setting


def test_severity_ranks_every_action_of_a_row() -> None:
    assert set(SEVERITY) == {policy.action(MISSION) for policy in POLICIES}


@pytest.mark.parametrize(
    ("position", "distance_m"),
    [((0, 0, 1), 0.0), ((1, 2, 3), 0.0), ((1.5, 0, 1), 0.5), ((0, -3, 1), 1.0), ((4, 6, 3), 5.0), ((0, 0, 0.25), 0.75)],
)
def test_the_distance_from_the_flight_region_is_measured_to_its_nearest_point(
    position: tuple[float, float, float], distance_m: float
) -> None:
    flight = Flight(lower_m=(-1.0, -2.0, 1.0), upper_m=(1.0, 2.0, 3.0))

    assert outside_m(flight, position) == pytest.approx(distance_m)
