"""Whoever is in the mission, or was ever heard of, stays an obstacle."""

from __future__ import annotations

import numpy as np
import pytest

from agents.team import Team
from protocol.messages import DroneState, ReplicaState
from protocol.mission import Flight

FLIGHT = Flight(response_time_s=0.2)
TICK_S = 0.05
STARTS = {drone: np.array([float(drone), 0.0, 2.0, 0.0, 1.3]) for drone in (1, 2, 5)}


def team() -> Team:
    """Of drone 2."""
    return Team(2, STARTS, FLIGHT, TICK_S)


def state(drone: int, tick: int, x: float, speed: float = 0.0) -> DroneState:
    return DroneState(
        drone=drone,
        tick=tick,
        pose=(x, 1.0, 2.0, 0.0, 1.3),
        velocity=(speed, 0.0, 0.0, 0.0, 0.0),
        battery=1.0,
        mode="flying",
        importance=1.0,
        replica=ReplicaState(tick=0, epoch=0, next_jump=0, missing=0, repaired=0, lost=0),
        control=None,
    )


def test_a_drone_that_never_spoke_is_an_obstacle_at_its_start_that_grows() -> None:
    neighbours = team().neighbours(20)

    assert [neighbour.drone for neighbour in neighbours] == [1, 5]
    assert [neighbour.position.tolist() for neighbour in neighbours] == [[1, 0, 2], [5, 0, 2]]
    assert [neighbour.age_s for neighbour in neighbours] == pytest.approx([1.0, 1.0])


def test_a_drone_is_no_obstacle_to_itself() -> None:
    own = team()
    own.hear(state(2, 3, 9.0), now=3)

    assert [neighbour.drone for neighbour in own.neighbours(3)] == [1, 5]


def test_a_neighbour_is_where_it_will_come_to_rest() -> None:
    known = team()
    known.hear(state(1, 8, x=3.0, speed=0.5), now=8)

    first = known.neighbours(8)[0]

    assert first.position == pytest.approx(np.array([3.1, 1.0, 2.0]))
    assert first.age_s == 0.0


def test_a_silent_neighbour_ages_by_the_ticks_since_its_last_state() -> None:
    known = team()
    known.hear(state(5, 8, x=3.0), now=8)

    assert [neighbour.age_s for neighbour in known.neighbours(28)] == pytest.approx([1.4, 1.0])


def test_an_older_state_never_replaces_a_newer_one() -> None:
    known = team()
    known.hear(state(1, 8, x=3.0), now=9)
    known.hear(state(1, 7, x=-3.0), now=9)

    assert known.neighbours(9)[0].position[0] == 3.0
    assert known.neighbours(9)[0].age_s == pytest.approx(TICK_S)


def test_a_state_ahead_of_the_tick_at_hand_has_no_age() -> None:
    known = team()
    known.hear(state(1, 12, x=3.0), now=10)

    assert known.neighbours(10)[0].age_s == 0.0


def test_a_clock_that_is_ahead_does_not_hide_that_its_drone_fell_silent() -> None:
    known = team()
    known.hear(state(1, 60, x=3.0), now=10)

    assert known.neighbours(50)[0].age_s == pytest.approx(1.95), "from the tick after its arrival"
    known.hear(state(1, 61, x=2.0), now=51)
    assert known.neighbours(51)[0].age_s == 0.0
    assert known.neighbours(51)[0].position[0] == 2.0


def test_a_state_that_comes_before_its_own_tick_has_no_age_at_that_tick() -> None:
    """Or two runs in lockstep would differ by which message came first."""
    known = team()
    known.hear(state(1, 8, x=3.0), now=7)

    assert known.neighbours(8)[0].age_s == 0.0


def test_the_time_until_a_command_is_flown_makes_all_neighbours_larger() -> None:
    known = team()
    known.hear(state(1, 8, x=3.0), now=8)

    assert [neighbour.age_s for neighbour in known.neighbours(8, delay_s=0.3)] == pytest.approx([0.3, 0.7])


def test_a_stranger_that_is_heard_of_becomes_an_obstacle_and_stays_one() -> None:
    known = team()
    known.hear(state(3, 8, x=3.0), now=8)

    assert [neighbour.drone for neighbour in known.neighbours(100)] == [1, 3, 5]


def test_one_that_said_it_has_landed_stays_what_it_is_though_its_process_ended() -> None:
    known = team()
    known.hear(state(1, 8, x=3.0).model_copy(update={"mode": "landed"}), now=8)
    assert known.neighbours(208)[0].age_s == 0.0
    assert known.neighbours(208, delay_s=0.1)[0].age_s == pytest.approx(0.1)

    known.hear(state(1, 209, x=3.0), now=209)
    assert known.neighbours(219)[0].age_s == pytest.approx(0.5), "it flies again"


def test_one_whose_agent_is_blind_grows_by_what_it_may_have_flown_and_no_further() -> None:
    known = team()
    for tick in (8, 48, 88):
        known.hear(state(1, tick, x=3.0).model_copy(update={"mode": "yielded", "blind_s": 1.5}), now=tick)
        assert known.neighbours(tick)[0].age_s == pytest.approx(1.5)


def told(drone: int, tick: int, x: float, position_sd_m: float) -> DroneState:
    return state(drone, tick, x).model_copy(update={"position_sd_m": position_sd_m})


def test_neighbours_keep_as_much_farther_away_as_both_estimates_may_be_off() -> None:
    known = team()
    known.hear(told(1, 8, 3.0, 0.1), now=8)

    assert [neighbour.error_m for neighbour in known.neighbours(8)] == pytest.approx([0.3, 0.0])
    assert [neighbour.error_m for neighbour in known.neighbours(8, position_sd_m=0.2)] == pytest.approx([0.9, 0.6])


def test_of_what_the_mission_and_a_drone_say_of_its_error_the_larger_counts() -> None:
    known = Team(2, STARTS, FLIGHT.model_copy(update={"position_error_m": 0.25}), TICK_S)
    known.hear(told(1, 8, 3.0, 0.05), now=8)
    known.hear(told(5, 8, 4.0, 0.1), now=8)

    assert [neighbour.error_m for neighbour in known.neighbours(8)] == pytest.approx([0.0, 0.05])
    assert known.neighbours(8, position_sd_m=0.1)[0].error_m == pytest.approx(0.05)


def test_where_others_said_to_be_before_a_tick_does_not_depend_on_who_spoke_first_in_it() -> None:
    known = team()
    known.hear(state(1, 7, 1.0), now=7)
    known.hear(state(5, 7, 3.0), now=7)
    before = known.places(8).tolist()
    known.hear(state(1, 8, 1.5), now=8)
    assert known.places(8).tolist() == before
    assert [x for x, *_ in known.places(9).tolist()] == [1.5, 3.0]
