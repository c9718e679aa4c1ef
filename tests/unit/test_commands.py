"""What an operator may command, and who has heard it."""

from __future__ import annotations

from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ground_station.commands import Command, CommandDesk, parse_command
from protocol.errors import MessageError
from protocol.messages import Phase
from protocol.verbs import Verb


def desk() -> CommandDesk:
    return CommandDesk([3, 1, 2])


def take(desk: CommandDesk, verb: Verb, *drones: int, identity: str = "", phase: Phase = "flying") -> Command:
    command = desk.consider(identity or f"{verb}{drones}", verb, drones, phase)
    assert isinstance(command, Command), command
    desk.take(command)
    return command


def actions(desk: CommandDesk) -> dict[int, str]:
    return {order.drone: order.action for order in desk.orders}


def test_a_command_without_drones_is_for_all() -> None:
    commanded = desk()
    take(commanded, "pause")
    assert actions(commanded) == {1: "hold", 2: "hold", 3: "hold"}


def test_a_command_for_one_drone_leaves_the_others_alone() -> None:
    commanded = desk()
    take(commanded, "land", 3)
    assert actions(commanded) == {3: "land"}


def test_resume_takes_a_pause_back_but_neither_a_return_nor_a_landing() -> None:
    commanded = desk()
    take(commanded, "pause")
    take(commanded, "land", 1)
    take(commanded, "return", 2)
    take(commanded, "resume")
    assert actions(commanded) == {1: "land", 2: "return", 3: "fly"}


def test_a_returning_drone_may_be_told_to_land_but_a_landing_one_not_to_return() -> None:
    commanded = desk()
    take(commanded, "return", 1)
    take(commanded, "land", 1)
    refused = commanded.consider("x", "return", (1,), "flying")
    assert refused == "nothing to return: drone 1 lands already"


def test_what_would_change_nothing_is_refused_with_the_reason() -> None:
    commanded = desk()
    assert commanded.consider("x", "resume", (), "flying") == (
        "nothing to resume: drone 1 flies, drone 2 flies, drone 3 flies"
    )


@pytest.mark.parametrize(
    ("verb", "drones", "phase", "why"),
    [
        ("land", (7,), "flying", "there is no drone 7; the mission has 1, 2, 3"),
        ("start", (), "flying", "the mission has started already"),
        ("start", (), "finished", "the mission is over"),
        ("start", (2,), "waiting", "start is for the whole mission"),
        ("abort", (2,), "flying", "abort is for the whole mission"),
        ("pause", (), "finished", "the mission is over"),
        ("abort", (), "finished", "the mission is over"),
    ],
)
def test_what_cannot_be_done_is_refused(verb: Verb, drones: tuple[int, ...], phase: Phase, why: str) -> None:
    refused = desk().consider("x", verb, drones, phase)
    assert isinstance(refused, str)
    assert why in refused


def test_drones_may_be_landed_after_the_mission() -> None:
    assert isinstance(desk().consider("x", "land", (), "finished"), Command)


def test_a_start_needs_no_acknowledgement() -> None:
    commanded = desk()
    command = take(commanded, "start", phase="waiting")
    assert commanded.started
    assert commanded.reply(command.id).awaited == ()


def test_an_abort_lands_all_and_ends_the_mission_also_when_all_land_already() -> None:
    commanded = desk()
    take(commanded, "land")
    take(commanded, "abort")
    assert commanded.aborted
    assert set(actions(commanded).values()) == {"land"}


def test_a_command_is_awaited_from_each_drone_until_it_says_so() -> None:
    commanded = desk()
    command = take(commanded, "pause")
    assert commanded.reply(command.id).awaited == (1, 2, 3)
    commanded.acknowledge(2, command.number)
    assert commanded.reply(command.id).awaited == (1, 3)
    commanded.acknowledge(1, command.number - 1)
    assert commanded.reply(command.id).awaited == (1, 3)


def test_a_later_order_that_was_heard_acknowledges_the_earlier_one() -> None:
    commanded = desk()
    earlier = take(commanded, "pause", 1)
    later = take(commanded, "land", 1)
    commanded.acknowledge(1, later.number)
    assert commanded.reply(earlier.id).awaited == commanded.reply(later.id).awaited == ()


def test_a_number_that_drones_know_is_never_given_again() -> None:
    """A ground station whose disk refused a command, and that died, does not know of it."""
    restarted = desk()
    restarted.acknowledge(2, 5)
    command = take(restarted, "land", 2)
    assert command.number == 6
    assert restarted.reply(command.id).awaited == (2,)


def test_drones_of_another_mission_acknowledge_nothing() -> None:
    commanded = desk()
    commanded.acknowledge(9, 4)
    assert take(commanded, "pause").number == 1


@given(
    st.lists(
        st.tuples(st.sampled_from([*get_args(Verb)]), st.sets(st.sampled_from([1, 2, 3])), st.booleans()), max_size=12
    )
)
def test_whatever_is_commanded_who_lands_never_flies_on_and_numbers_ascend(
    pressed: list[tuple[Verb, set[int], bool]],
) -> None:
    commanded, again = desk(), desk()
    landing: set[int] = set()
    numbers = [0]
    for index, (verb, drones, acknowledged) in enumerate(pressed):
        command = commanded.consider(f"id{index}", verb, tuple(sorted(drones)), "flying")
        if isinstance(command, str):
            continue
        commanded.take(command)
        again.take(command)
        numbers.append(command.number)
        if acknowledged:
            for drone in command.drones:
                commanded.acknowledge(drone, command.number)
        now = actions(commanded)
        assert all(now[drone] == "land" for drone in landing)
        landing |= {drone for drone, action in now.items() if action == "land"}
    assert numbers == sorted(set(numbers))
    assert again.orders == commanded.orders, "a restarted desk comes to the same"


def test_a_command_is_read_from_a_query() -> None:
    assert parse_command({"id": "a1", "verb": "land", "drones": "4+3+4"}) == ("a1", "land", (3, 4))
    assert parse_command({"id": "a1", "verb": "pause"}) == ("a1", "pause", ())


@pytest.mark.parametrize(
    ("parameters", "why"),
    [
        ({"verb": "land"}, "an id of 1 to 64"),
        ({"id": "x" * 65, "verb": "land"}, "an id of 1 to 64"),
        ({"id": "a;b", "verb": "land"}, "an id of 1 to 64"),
        ({"id": "a1"}, "is none of start, pause"),
        ({"id": "a1", "verb": "explode"}, "'explode' is none of start, pause"),
        ({"id": "a1", "verb": "land", "drones": "all"}, "numbers joined by +"),
    ],
)
def test_what_is_no_command_is_refused(parameters: dict[str, str], why: str) -> None:
    with pytest.raises(MessageError) as refused:
        parse_command(parameters)
    assert why in str(refused.value)


def test_resume_clears_a_drone_with_another_battery_only_where_a_crew_swaps() -> None:
    assert isinstance(desk().consider("x", "resume", (1,), "flying"), str), "nobody is paused"
    commanded = CommandDesk([3, 1, 2], clears_swapped=True)
    first = take(commanded, "resume", 1, identity="a")
    second = take(commanded, "resume", 1, identity="b")
    assert actions(commanded) == {1: "fly"}
    assert second.number > first.number, "each swap is cleared anew"
    take(commanded, "land", 1)
    assert isinstance(commanded.consider("c", "resume", (1,), "flying"), str)
