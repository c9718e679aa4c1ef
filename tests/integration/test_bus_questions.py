"""Questions and answers over real zenoh: each ends, whatever becomes of who was asked."""

from __future__ import annotations

import asyncio
import threading
from functools import partial

import numpy as np
import pytest

from faults.buses import PATIENCE_S, page, there
from protocol import topics
from protocol.bus import Bus, connect
from protocol.errors import MessageError, NoReply
from protocol.messages import JournalPage, Jump
from protocol.queries import parse_parameters
from protocol.topics import Topic
from protocol.wire import MAX_MESSAGE_BYTES, encode

PRIVATE = Topic(
    "drone/{drone}/private", JournalPage, ("agent",), ("agent",), "BACKGROUND", 4, 1.0, False, 2**20, queryable=True
)


async def test_a_question_is_answered_in_the_loop_with_its_parameters(ground: Bus, drone: Bus) -> None:
    asked: list[tuple[dict[str, str], str]] = []
    jump = encode(Jump(epoch=7, sequence=3, tick=9, increments=np.ones(4, np.float32)))

    async def answer(parameters: dict[str, str]) -> JournalPage:
        asked.append((parameters, threading.current_thread().name))
        return JournalPage(epoch=7, first_sequence=0, next_sequence=4, jumps=(jump,))

    ground.serve(topics.JOURNAL, answer)
    await there(drone, ground, "ground")

    page = await drone.ask(topics.JOURNAL, "from=3;to=4")

    assert page == JournalPage(epoch=7, first_sequence=0, next_sequence=4, jumps=(jump,))
    assert asked == [({"from": "3", "to": "4"}, threading.main_thread().name)]


async def test_a_question_that_nobody_answers_is_an_error(drone: Bus) -> None:
    async with asyncio.timeout(PATIENCE_S):
        with pytest.raises(NoReply, match=r"phi/journal\?from=0;to=1: no valid answer"):
            await drone.ask(topics.JOURNAL, "from=0;to=1")


async def test_an_answer_that_is_too_long_to_send_is_no_answer_and_the_next_one_is(ground: Bus, drone: Bus) -> None:
    async def answer(parameters: dict[str, str]) -> JournalPage:
        jumps = (bytes(MAX_MESSAGE_BYTES),) if parameters["from"] == "0" else ()
        return JournalPage(epoch=7, first_sequence=0, next_sequence=0, jumps=jumps)

    ground.serve(topics.JOURNAL, answer)
    await there(drone, ground, "ground")

    async with asyncio.timeout(PATIENCE_S):
        with pytest.raises(NoReply):
            await drone.ask(topics.JOURNAL, "from=0")
        assert (await drone.ask(topics.JOURNAL, "from=1")).epoch == 7


async def test_each_drone_answers_for_itself(ground: Bus, drone: Bus, endpoint: str) -> None:
    async def answer(parameters: dict[str, str], epoch: int) -> JournalPage:
        assert parameters == {"from": "0"}
        return page(epoch)

    async with connect(endpoint, "m") as second:
        for number, bus in ((1, drone), (2, second)):
            bus.serve(PRIVATE, partial(answer, epoch=number), number)
            await there(ground, bus, f"drone/{number}")

        assert [(await ground.ask(PRIVATE, "from=0", number)).epoch for number in (1, 2)] == [1, 2]
        with pytest.raises(NoReply, match=r"drone/3/private\?from=0"):
            await ground.ask(PRIVATE, "from=0", 3)


async def test_an_answer_that_takes_its_time_keeps_nobody_waiting(ground: Bus, drone: Bus) -> None:
    may_answer = asyncio.Event()

    async def answer(parameters: dict[str, str]) -> JournalPage:
        if "slow" in parameters:
            await may_answer.wait()
        return page(epoch=len(parameters))

    ground.serve(topics.JOURNAL, answer)
    await there(drone, ground, "ground")
    slow = asyncio.create_task(drone.ask(topics.JOURNAL, "slow=1;at=2", timeout_s=PATIENCE_S))
    with pytest.raises(NoReply):
        await drone.ask(topics.JOURNAL, "slow=1", timeout_s=0.2)

    assert (await drone.ask(topics.JOURNAL, "from=1")).epoch == 1
    assert not slow.done()
    may_answer.set()
    assert (await slow).epoch == 2


@pytest.mark.parametrize(("error", "failures"), [(MessageError("not here"), 0), (KeyError("a mistake"), 1)])
async def test_a_question_that_is_refused_or_fails_ends_at_once_and_the_next_is_answered(
    ground: Bus, drone: Bus, error: Exception, failures: int
) -> None:
    async def answer(parameters: dict[str, str]) -> JournalPage:
        if parameters["from"] == "0":
            raise error
        return page(epoch=7)

    ground.serve(topics.JOURNAL, answer)
    await there(drone, ground, "ground")

    async with asyncio.timeout(PATIENCE_S):
        with pytest.raises(NoReply):
            await drone.ask(topics.JOURNAL, "from=0", timeout_s=10 * PATIENCE_S)
        assert (await drone.ask(topics.JOURNAL, "from=1")).epoch == 7
    assert ground.statistics.failed[topics.JOURNAL.key] == failures


async def test_more_questions_than_a_topic_has_room_for_get_no_answer_and_are_counted(ground: Bus, drone: Bus) -> None:
    may_answer = asyncio.Event()

    async def answer(parameters: dict[str, str]) -> JournalPage:
        assert not parameters
        await may_answer.wait()
        return page(epoch=7)

    ground.serve(topics.JOURNAL, answer)
    await there(drone, ground, "ground")
    room, extra = topics.JOURNAL.queue, 5

    async with asyncio.TaskGroup() as group:
        asked = [group.create_task(_epoch_or_zero(drone)) for _ in range(room + extra)]
        pending = set(asked)
        while len(pending) > room:
            _, pending = await asyncio.wait(pending, timeout=PATIENCE_S, return_when=asyncio.FIRST_COMPLETED)
        may_answer.set()
    assert sorted(task.result() for task in asked) == [0] * extra + [7] * room
    assert ground.statistics.dropped == {topics.JOURNAL.key: extra}
    assert (await drone.ask(topics.JOURNAL, "")).epoch == 7, "there is room again"


async def test_a_process_that_ends_while_it_answers_does_not_let_the_asker_wait(endpoint: str, ground: Bus) -> None:
    asked = asyncio.Event()

    async def answer(parameters: dict[str, str]) -> JournalPage:
        assert not parameters
        asked.set()
        await asyncio.Event().wait()
        raise AssertionError

    async with asyncio.timeout(PATIENCE_S):
        async with connect(endpoint, "m") as other:
            other.serve(topics.JOURNAL, answer)
            await there(ground, other)
            asking = asyncio.create_task(ground.ask(topics.JOURNAL, "", timeout_s=10 * PATIENCE_S))
            await asked.wait()
        with pytest.raises(NoReply):
            await asking


def test_parameters_are_read_as_far_as_they_make_sense() -> None:
    assert parse_parameters("from=3;to=9") == {"from": "3", "to": "9"}
    assert parse_parameters("") == {}
    assert parse_parameters("from=;=4;flag") == {"from": "", "flag": ""}


async def _epoch_or_zero(bus: Bus) -> int:
    try:
        return (await bus.ask(topics.JOURNAL, "", timeout_s=PATIENCE_S)).epoch
    except NoReply:
        return 0
