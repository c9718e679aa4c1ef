"""A command is asked for until everybody has acknowledged it, or until a newer one or silence ends it."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from typing import cast

import pytest

from ground_station.commands import CommandDesk, parse_command, refusal
from ground_station.console import command_sender
from ground_station.console.command_sender import CommandSender, Progress
from protocol.bus import Bus
from protocol.errors import NoReply
from protocol.messages import CommandReply
from protocol.queries import parse_parameters
from protocol.topics import COMMAND, Topic

PATIENCE_S = 10.0


class Ground:
    """A bus behind which a ground station's desk sits."""

    def __init__(self) -> None:
        self.desk = CommandDesk([1, 2, 3])
        self.answers = True
        self.questions: list[str] = []

    async def ask(self, topic: Topic[CommandReply], parameters: str, timeout_s: float) -> CommandReply:
        assert topic is COMMAND
        assert timeout_s > 0
        self.questions.append(parameters)
        await asyncio.sleep(0)
        if not self.answers:
            raise NoReply("nobody")
        identity, verb, drones = parse_command(parse_parameters(parameters))
        if not self.desk.known(identity):
            command = self.desk.consider(identity, verb, drones, "flying")
            if isinstance(command, str):
                return refusal(identity, command)
            self.desk.take(command)
        return self.desk.reply(identity)


@pytest.fixture
def ground() -> Ground:
    return Ground()


@pytest.fixture
async def sender(ground: Ground, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[CommandSender]:
    monkeypatch.setattr(command_sender, "ASK_AGAIN_S", 0.001)
    made = CommandSender(cast("Bus", ground), lambda: None)
    yield made
    await made.close()


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(PATIENCE_S):
        while not condition():  # noqa: ASYNC110  # of what is not ours to signal
            await asyncio.sleep(0)


async def reach(sender: CommandSender, progress: Progress, place: int = 0) -> None:
    """``place``: 0 for the newest command."""
    await until(lambda: sender.newest_first[place].progress == progress)


async def test_the_same_command_is_asked_for_until_the_last_drone_has_heard_it(
    ground: Ground, sender: CommandSender
) -> None:
    sender.send("pause", (2, 3))
    await reach(sender, "awaited")
    ground.desk.acknowledge(2, 1)
    await until(lambda: sender.newest_first[0].awaited == (3,))
    ground.desk.acknowledge(3, 1)
    await reach(sender, "acknowledged")

    assert len(ground.questions) >= 3
    assert len(set(ground.questions)) == 1


async def test_a_command_that_nobody_answers_is_given_up(
    ground: Ground, sender: CommandSender, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command_sender, "UNANSWERED_S", 0.01)
    ground.answers = False

    sender.send("land")
    assert sender.newest_first[0].progress == "asked"
    await reach(sender, "unanswered")

    asked = len(ground.questions)
    ground.answers = True
    for _ in range(20):
        await asyncio.sleep(0.001)
    assert len(ground.questions) == asked


async def test_an_accepted_command_is_not_given_up_while_the_ground_station_is_away(
    ground: Ground, sender: CommandSender, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command_sender, "UNANSWERED_S", 0.0)
    sender.send("pause")
    await reach(sender, "awaited")

    ground.answers = False
    await until(lambda: not sender.newest_first[0].link)
    assert sender.newest_first[0].progress == "awaited"
    ground.answers = True
    for drone in (1, 2, 3):
        ground.desk.acknowledge(drone, 1)

    await reach(sender, "acknowledged")
    assert sender.newest_first[0].link


async def test_a_newer_command_for_the_same_drones_ends_the_asking_for_the_older(
    ground: Ground, sender: CommandSender
) -> None:
    ground.answers = False
    sender.send("pause", (3,))
    await until(lambda: bool(ground.questions))
    sender.send("land")
    ground.questions.clear()
    await until(lambda: len(ground.questions) > 5)

    assert sender.newest_first[1].progress == "replaced"
    assert all("verb=land" in question for question in ground.questions)


@pytest.mark.parametrize(("older", "drones"), [("pause", (3,)), ("abort", ())])
async def test_neither_another_drones_command_nor_the_end_of_the_mission_is_replaced(
    ground: Ground, sender: CommandSender, older: str, drones: tuple[int, ...]
) -> None:
    ground.answers = False
    sender.send(older, drones)  # type: ignore[arg-type]  # a verb
    sender.send("land", (1,))
    if older == "abort":
        sender.send("pause")
    ground.answers = True

    await reach(sender, "awaited", place=len(sender.newest_first) - 1)


async def test_a_refusal_is_final(ground: Ground, sender: CommandSender) -> None:
    sender.send("resume")
    await reach(sender, "refused")

    assert sender.newest_first[0].text.startswith("nothing to resume")
    assert len(ground.questions) == 1
