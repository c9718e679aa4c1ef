"""Processes hear each other over real zenoh, and what goes wrong is an error, a count or a missing life."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import cast

import pytest
import zenoh

from faults.buses import PATIENCE_S, page, there
from protocol import topics
from protocol.bus import Bus, connect
from protocol.errors import BusError, MessageError, NoReply
from protocol.guard import ROOT
from protocol.messages import JournalPage, JumpHead, Keyframe, MissionPhase
from protocol.wire import encode

IMAGES, IMAGE_BYTES = 40, 150_000
"""More than the buffers between sender and receiver hold: sockets' and zenoh's queues, about 3 MB."""
BEAT_S, BEATS_PER_IMAGE = 0.01, 5
LATE_S, LATE_SHARE = 0.1, 0.1
"""A put that blocks until the frozen link is given up makes a fifth of all messages later than this."""
KEYFRAME = Keyframe(
    drone=1,
    sequence=0,
    tick=0,
    position=(0.0, 0.0, 0.0),
    rotation=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    width=320,
    height=180,
    fx=1.0,
    fy=1.0,
    cx=0.0,
    cy=0.0,
    jpeg=b"",
)
CLIENT = """
import asyncio, sys
from protocol import topics
from protocol.bus import connect
from protocol.messages import JumpHead

async def main() -> None:
    async with connect(sys.argv[1], "m", lossless=True) as bus:
        bus.on(topics.PHASE, lambda phase: None)
        bus.watch_lives()
        bus.announce("drone/9")
        print("there", flush=True)
        await bus.until(lambda: False, float(sys.argv[2]))
        for done in range(200):
            bus.put(topics.HEAD, JumpHead(epoch=1, next_sequence=0, done=done, phase="flying"))

asyncio.run(main())
"""

ROUTER = """
import asyncio, sys
from protocol.bus import connect

async def main() -> None:
    async with connect(sys.argv[1], "m", router=True):
        print("there", flush=True)
        await asyncio.Event().wait()

asyncio.run(main())
"""
LISTENER = """
import asyncio, sys
from protocol import topics
from protocol.bus import connect

async def main() -> None:
    async with connect(sys.argv[1], "m") as bus:
        bus.on(topics.KEYFRAME, lambda _: None)
        bus.on(topics.HEAD, lambda _: None)
        print("there", flush=True)
        await asyncio.Event().wait()

asyncio.run(main())
"""


@contextmanager
def process(script: str, endpoint: str) -> Iterator[subprocess.Popen[bytes]]:
    """A process that has said that it is there; killed at the end."""
    with subprocess.Popen([sys.executable, "-c", script, endpoint], cwd=ROOT, stdout=subprocess.PIPE) as started:
        try:
            assert started.stdout is not None
            assert started.stdout.readline() == b"there\n"
            yield started
        finally:
            started.kill()


async def no_answer(parameters: dict[str, str]) -> JournalPage:
    raise MessageError(f"nothing at {parameters}")


def head(done: int) -> JumpHead:
    return JumpHead(epoch=1, next_sequence=0, done=done, phase="flying")


def blocked_until(condition: Callable[[], bool]) -> None:
    """Keep the event loop from running until ``condition`` holds: `Bus.until` would let it drain the queues."""
    pause = threading.Event()
    assert any(condition() or pause.wait(0.001) for _ in range(int(PATIENCE_S / 0.001)))


async def test_what_one_puts_the_other_hears_in_order(ground: Bus, drone: Bus) -> None:
    heard: list[int] = []
    drone.on(topics.HEAD, lambda message: heard.append(message.done))
    await there(ground, drone)

    for done in range(200):
        ground.put(topics.HEAD, head(done))

    assert await drone.until(lambda: len(heard) == 200, PATIENCE_S)
    assert heard == list(range(200))
    assert not drone.statistics.dropped
    assert not drone.statistics.refused


async def test_several_handlers_share_a_key_and_each_hears_all(ground: Bus, drone: Bus) -> None:
    one: list[int] = []
    other: list[int] = []
    drone.on(topics.HEAD, lambda message: one.append(message.done))
    drone.on(topics.HEAD, lambda message: other.append(message.done))
    await there(ground, drone)

    ground.put(topics.HEAD, head(1))
    ground.put(topics.HEAD, head(2))

    assert await drone.until(lambda: len(other) == 2, PATIENCE_S)
    assert one == other == [1, 2]


async def test_each_drone_has_its_key_and_one_can_listen_to_all_or_to_one(ground: Bus, drone: Bus) -> None:
    all_of_them: list[int] = []
    second: list[int] = []
    ground.on(topics.KEYFRAME, lambda frame: all_of_them.append(frame.drone))
    ground.on(topics.KEYFRAME, lambda frame: second.append(frame.drone), drone=2)
    await there(drone, ground, "ground")
    for number in (1, 2, 3):
        drone.put(topics.KEYFRAME, KEYFRAME.model_copy(update={"drone": number}), number)

    assert await ground.until(lambda: len(all_of_them) == 3 and bool(second), PATIENCE_S)
    assert (all_of_them, second) == ([1, 2, 3], [2])


async def test_a_process_does_not_hear_itself(ground: Bus, drone: Bus) -> None:
    own: list[int] = []
    others: list[int] = []
    ground.on(topics.HEAD, lambda message: own.append(message.done))
    drone.on(topics.HEAD, lambda message: others.append(message.done))
    await there(ground, drone)
    await there(drone, ground, "ground")

    ground.put(topics.HEAD, head(1))
    assert await drone.until(lambda: bool(others), PATIENCE_S)
    drone.put(topics.HEAD, head(2))
    assert await ground.until(lambda: bool(own), PATIENCE_S)

    assert (own, others) == ([2], [1])


async def test_missions_on_one_router_do_not_hear_each_other(endpoint: str, ground: Bus, drone: Bus) -> None:
    ours: list[int] = []
    theirs: list[int] = []
    drone.on(topics.HEAD, lambda message: ours.append(message.done))
    async with connect(endpoint, "n", lossless=True) as listener, connect(endpoint, "n", lossless=True) as other:
        listener.on(topics.HEAD, lambda message: theirs.append(message.done))
        other.watch_lives()
        await there(other, listener)
        await there(ground, drone)

        other.put(topics.HEAD, head(1))
        assert await listener.until(lambda: bool(theirs), PATIENCE_S)
        ground.put(topics.HEAD, head(2))
        assert await drone.until(lambda: bool(ours), PATIENCE_S)

    assert (ours, theirs) == ([2], [1])


async def test_a_reader_that_is_too_slow_loses_the_oldest_and_they_are_counted(ground: Bus, drone: Bus) -> None:
    room, sent = topics.PHASE.queue, 100
    heard: list[str] = []
    drone.on(topics.PHASE, lambda message: heard.append(message.reason))
    await there(ground, drone)
    key = topics.PHASE.of("*")

    for number in range(sent):
        ground.put(topics.PHASE, MissionPhase(phase="flying", reason=str(number)))
    blocked_until(lambda: drone.statistics.dropped[key] == sent - room)

    assert await drone.until(lambda: bool(heard), PATIENCE_S)
    assert heard == [str(number) for number in range(sent - room, sent)]
    assert drone.statistics.dropped == {key: sent - room}


async def test_bytes_that_are_no_message_are_counted_and_later_ones_still_heard(ground: Bus, drone: Bus) -> None:
    heard: list[int] = []
    drone.on(topics.HEAD, lambda message: heard.append(message.done))
    await there(ground, drone)

    for payload in (b"", b"rubbish", encode(MissionPhase(phase="flying", reason="")), encode(head(1))[:-1]):
        ground.put_encoded(topics.HEAD, payload)
    ground.put(topics.HEAD, head(5))

    assert await drone.until(lambda: bool(heard), PATIENCE_S)
    assert heard == [5]
    assert drone.statistics.refused == {topics.HEAD.key: 4}


async def test_what_does_not_wake_is_handled_with_what_does(ground: Bus, drone: Bus) -> None:
    heard: list[object] = []
    drone.on(topics.HEAD, lambda message: heard.append(message.done), wakes=False)
    drone.on(topics.PHASE, lambda message: heard.append(message.reason))
    await there(ground, drone)
    assert await drone.until(lambda: "drone/1" in drone.alive, PATIENCE_S), "or the news of it would wake us later"

    for done in range(100):
        ground.put(topics.HEAD, head(done))
    assert not await drone.until(lambda: bool(heard), 0.1)
    ground.put(topics.PHASE, MissionPhase(phase="flying", reason="now"))

    assert await drone.until(lambda: len(heard) == 101, PATIENCE_S)
    heard.remove("now")
    assert heard == list(range(100))


async def test_what_does_not_wake_is_handled_by_a_poll_and_the_newest_are_kept(ground: Bus, drone: Bus) -> None:
    room, sent = topics.PHASE.queue, 100
    heard: list[str] = []
    last: list[int] = []
    drone.on(topics.PHASE, lambda message: heard.append(message.reason), wakes=False)
    drone.on(topics.HEAD, lambda message: last.append(message.done), wakes=False)
    await there(ground, drone)
    for number in range(sent):
        ground.put(topics.PHASE, MissionPhase(phase="flying", reason=str(number)))
    ground.put(topics.HEAD, head(1))

    def all_are_in() -> bool:
        drone.poll()
        return bool(heard) and heard[-1] == str(sent - 1) and bool(last)

    waiting = asyncio.create_task(drone.until(lambda: bool(last), PATIENCE_S))
    await asyncio.sleep(0)
    blocked_until(all_are_in)
    assert await waiting, "a poll rechecks what is waited for"
    assert heard[-room:] == [str(number) for number in range(sent - room, sent)]


@pytest.mark.parametrize("wakes", [True, False])
async def test_a_key_is_heard_no_more_and_then_again(ground: Bus, drone: Bus, wakes: bool) -> None:
    heard: list[int] = []
    other: list[int] = []
    drone.on(topics.HEAD, lambda message: other.append(message.done), wakes=not wakes)
    for said in (1, 2, 3):
        if said == 2:
            drone.off(topics.HEAD, wakes=wakes)
        else:
            drone.on(topics.HEAD, lambda message: heard.append(message.done), wakes=wakes)
        await there(ground, drone, f"round/{said}")
        ground.put(topics.HEAD, head(said))

        def arrived(said: int = said) -> bool:
            drone.poll()
            # zenoh hands a message to one subscriber after the other: that one has it does not say that both have.
            return other[-1:] == [said] and (said == 2 or heard[-1:] == [said])

        blocked_until(arrived)

    assert other == [1, 2, 3]
    assert heard == [1, 3]


async def test_a_key_can_be_heard_both_ways(ground: Bus, drone: Bus) -> None:
    waking: list[int] = []
    polled: list[int] = []
    drone.on(topics.HEAD, lambda message: waking.append(message.done))
    drone.on(topics.HEAD, lambda message: polled.append(message.done), wakes=False)
    await there(ground, drone)

    ground.put(topics.HEAD, head(3))

    def both_have_it() -> bool:
        drone.poll()
        return bool(waking) and bool(polled)

    blocked_until(both_have_it)
    assert (waking, polled) == ([3], [3])


@pytest.mark.parametrize("wakes", [True, False])
async def test_a_handler_that_fails_costs_nobody_else_a_message(
    ground: Bus, drone: Bus, wakes: bool, caplog: pytest.LogCaptureFixture
) -> None:
    heard: list[int] = []
    last: list[str] = []

    def fail(message: JumpHead) -> None:
        raise ZeroDivisionError(message.done)

    drone.on(topics.HEAD, fail, wakes=wakes)
    drone.on(topics.HEAD, lambda message: heard.append(message.done), wakes=wakes)
    drone.on(topics.PHASE, lambda message: last.append(message.reason))
    await there(ground, drone)

    for done in range(10):
        ground.put(topics.HEAD, head(done))
    ground.put(topics.PHASE, MissionPhase(phase="flying", reason="end"))

    def all_are_in() -> bool:
        drone.poll()
        return len(heard) == 10 and bool(last)

    blocked_until(all_are_in)
    assert heard == list(range(10))
    assert drone.statistics.failed == {topics.HEAD.key: 10}
    told = [record for record in caplog.records if record.name == "protocol.message_faults"]
    assert [record.args for record in told] == [(topics.HEAD.key, count) for count in (1, 2, 4, 8)]
    assert all(record.exc_info and record.exc_info[0] is ZeroDivisionError for record in told)


async def test_a_condition_that_fails_fails_only_where_it_is_waited_for(ground: Bus, drone: Bus) -> None:
    heard: list[int] = []
    drone.on(topics.HEAD, lambda message: heard.append(message.done))
    await there(ground, drone)

    def fail() -> bool:
        return bool(heard) and heard[1] == 0

    failing = asyncio.create_task(drone.until(fail, PATIENCE_S))
    waiting = asyncio.create_task(drone.until(lambda: bool(heard), PATIENCE_S))
    await asyncio.sleep(0)
    ground.put(topics.HEAD, head(1))

    assert await waiting
    with pytest.raises(IndexError):
        await failing


async def test_any_thread_may_put(ground: Bus, drone: Bus) -> None:
    heard: list[int] = []
    drone.on(topics.HEAD, lambda message: heard.append(message.done))
    await there(ground, drone)

    await asyncio.gather(*[asyncio.to_thread(ground.put, topics.HEAD, head(done)) for done in range(20)])

    assert await drone.until(lambda: len(heard) == 20, PATIENCE_S)
    assert sorted(heard) == list(range(20))


async def test_waiting_ends_by_the_condition_by_a_recheck_or_by_the_time_out(ground: Bus) -> None:
    done: list[int] = []
    assert await ground.until(lambda: True, 0.0)
    assert not await ground.until(lambda: bool(done), 0.01)

    waiting = asyncio.create_task(ground.until(lambda: bool(done), PATIENCE_S))
    await asyncio.sleep(0)
    done.append(1)
    assert not waiting.done()
    ground.recheck()
    async with asyncio.timeout(PATIENCE_S / 2):
        assert await waiting


async def test_a_life_appears_and_ends_with_its_process(endpoint: str, ground: Bus) -> None:
    ground.announce("ground")
    async with connect(endpoint, "m") as late:
        late.watch_lives()
        assert await late.until(lambda: "ground" in late.alive, PATIENCE_S), "also those who were there before"
        late.announce("drone/4")
        assert await ground.until(lambda: "drone/4" in ground.alive, PATIENCE_S)
    assert await ground.until(lambda: "drone/4" not in ground.alive, PATIENCE_S)


async def test_a_process_that_is_killed_is_missed(endpoint: str, ground: Bus) -> None:
    process = subprocess.Popen([sys.executable, "-c", CLIENT, endpoint, "60"], cwd=ROOT)  # noqa: ASYNC220
    try:
        assert await ground.until(lambda: "drone/9" in ground.alive, PATIENCE_S)
        process.send_signal(signal.SIGKILL)
        assert await ground.until(lambda: "drone/9" not in ground.alive, PATIENCE_S)
    finally:
        process.kill()
        process.wait()


async def test_a_process_that_talks_to_the_last_moment_ends_by_itself(endpoint: str, ground: Bus) -> None:
    heard: list[int] = []
    ground.on(topics.HEAD, lambda message: heard.append(message.done))
    ended = await asyncio.to_thread(
        subprocess.run,
        [sys.executable, "-c", CLIENT, endpoint, "0"],
        cwd=ROOT,
        check=False,
        capture_output=True,
        timeout=PATIENCE_S,
        env=os.environ | {"PYTHONWARNINGS": "error"},
    )

    assert (ended.returncode, ended.stdout, ended.stderr) == (0, b"there\n", b"")
    assert await ground.until(lambda: bool(heard) and heard[-1] == 199, PATIENCE_S)


async def test_a_process_ends_by_itself_after_its_router_is_gone(endpoint: str) -> None:
    async with connect(endpoint, "m", router=True) as router:
        router.watch_lives()
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-c", CLIENT, endpoint, "1", cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        assert await router.until(lambda: "drone/9" in router.alive, PATIENCE_S)

    async with asyncio.timeout(PATIENCE_S):
        output, errors = await process.communicate()
    assert (process.returncode, output, errors) == (0, b"there\n", b"")


async def test_a_router_that_is_killed_and_comes_back_is_all_that_changes(endpoint: str) -> None:
    """Nothing raises meanwhile, everybody counts as gone, and all that was declared works again."""
    heard: list[int] = []
    polled: list[int] = []

    async def answer(parameters: dict[str, str]) -> JournalPage:
        assert not parameters
        return page(epoch=7)

    with process(ROUTER, endpoint) as router:
        async with connect(endpoint, "m") as one, connect(endpoint, "m") as other:
            other.on(topics.HEAD, lambda message: heard.append(message.done))
            other.on(topics.HEAD, lambda message: polled.append(message.done), wakes=False)
            other.serve(topics.JOURNAL, answer)
            other.watch_lives()
            one.watch_lives()
            one.announce("drone/1")
            await there(one, other, "drone/2")

            router.kill()
            assert await one.until(lambda: not one.alive, PATIENCE_S)
            assert await other.until(lambda: not other.alive, PATIENCE_S)
            one.put(topics.HEAD, head(1))
            with pytest.raises(NoReply):
                await one.ask(topics.JOURNAL, "")

            with process(ROUTER, endpoint):
                assert await one.until(lambda: one.alive == {"drone/1", "drone/2"}, PATIENCE_S)
                assert await other.until(lambda: other.alive == {"drone/1", "drone/2"}, PATIENCE_S)
                one.put(topics.HEAD, head(2))

                def both_have_it() -> bool:
                    other.poll()
                    return bool(heard) and bool(polled)

                blocked_until(both_have_it)
                assert (heard, polled) == ([2], [2])
                assert (await one.ask(topics.JOURNAL, "")).epoch == 7


async def test_a_receiver_that_is_frozen_delays_neither_the_sender_nor_the_others(endpoint: str) -> None:
    """Images beyond all its buffers, put from a thread as the camera does, and small messages on time meanwhile."""
    frame = KEYFRAME.model_copy(update={"jpeg": bytes(IMAGE_BYTES)})
    late_s: list[float] = []
    put_s: list[float] = []
    async with connect(endpoint, "m", router=True), connect(endpoint, "m") as sender, connect(endpoint, "m") as other:
        began = time.monotonic()
        frames: list[int] = []
        other.on(topics.HEAD, lambda message: late_s.append(time.monotonic() - began - message.done * BEAT_S))
        other.on(topics.KEYFRAME, lambda message: frames.append(message.sequence))
        sender.watch_lives()
        with process(LISTENER, endpoint) as frozen:
            await there(sender, other)
            frozen.send_signal(signal.SIGSTOP)
            began = time.monotonic()

            def shoot() -> None:
                for sequence in range(IMAGES):
                    due = began + sequence * BEATS_PER_IMAGE * BEAT_S
                    time.sleep(max(0.0, due - time.monotonic()))  # the camera's rate, not a wait for something
                    before = time.monotonic()
                    sender.put(topics.KEYFRAME, frame.model_copy(update={"sequence": sequence}), 1)
                    put_s.append(time.monotonic() - before)

            shooting = asyncio.create_task(asyncio.to_thread(shoot))
            for beat in range(IMAGES * BEATS_PER_IMAGE):
                await asyncio.sleep(max(0.0, began + beat * BEAT_S - time.monotonic()))
                sender.put(topics.HEAD, head(beat))
            await shooting
            assert await other.until(lambda: len(late_s) == IMAGES * BEATS_PER_IMAGE, PATIENCE_S)
    assert sum(late > LATE_S for late in late_s) < LATE_SHARE * len(late_s)
    assert sum(took > LATE_S for took in put_s) < LATE_SHARE * len(put_s)
    assert len(frames) > 0.9 * IMAGES


async def test_a_link_that_cannot_be_closed_in_order_is_told_and_given_up(caplog: pytest.LogCaptureFixture) -> None:
    class Stuck:
        def close(self) -> None:
            raise zenoh.ZError("close operation timed out at /where/it/is.rs:7.")

    await Bus(cast("zenoh.Session", Stuck()), lossless=False).close()

    assert "close: close operation timed out" in caplog.messages


async def test_an_endpoint_that_is_taken_is_an_error_and_its_owner_goes_on(endpoint: str, ground: Bus) -> None:
    with pytest.raises(BusError, match=f"cannot listen at {endpoint}"):
        async with connect(endpoint, "m", router=True):
            pass

    heard: list[int] = []
    ground.on(topics.HEAD, lambda message: heard.append(message.done))
    ground.announce("ground")
    async with connect(endpoint, "m") as client:
        client.watch_lives()
        assert await client.until(lambda: "ground" in client.alive, PATIENCE_S)
        client.put(topics.HEAD, head(1))
        assert await ground.until(lambda: heard == [1], PATIENCE_S)


async def test_an_endpoint_is_free_again_after_its_owner_closed(endpoint: str) -> None:
    for _ in range(2):
        async with connect(endpoint, "m", router=True):
            pass


async def test_a_router_that_is_not_there_is_an_error_after_the_time_out(endpoint: str) -> None:
    async with asyncio.timeout(PATIENCE_S):
        with pytest.raises(BusError, match=f"cannot reach {endpoint}"):
            async with connect(endpoint, "m", timeout_s=0.1):
                pass


async def test_a_client_waits_for_a_router_that_comes_later(endpoint: str) -> None:
    async def fetch_life() -> bool:
        async with connect(endpoint, "m", timeout_s=PATIENCE_S) as early:
            early.watch_lives()
            return await early.until(lambda: "ground" in early.alive, PATIENCE_S)

    waiting = asyncio.create_task(fetch_life())
    await asyncio.sleep(0)
    async with connect(endpoint, "m", router=True) as router:
        router.announce("ground")
        assert await waiting


@pytest.mark.parametrize("malformed", ["", "rubbish", "unixsock-stream/"])
@pytest.mark.parametrize("router", [True, False])
async def test_a_malformed_endpoint_is_an_error_at_once(malformed: str, router: bool) -> None:
    async with asyncio.timeout(PATIENCE_S):
        with pytest.raises(BusError, match=f"{malformed or 'an empty endpoint'}: Endpoints must be of the form"):
            async with connect(malformed, "m", router=router, timeout_s=10 * PATIENCE_S):
                pass


async def test_a_closed_bus_refuses_everything_with_its_own_error(endpoint: str) -> None:
    async with connect(endpoint, "m", router=True) as bus:
        bus.put(topics.HEAD, head(1))
    for act in (
        lambda: bus.put(topics.HEAD, head(2)),
        lambda: bus.put(topics.PHASE, MissionPhase(phase="flying", reason="")),
        lambda: bus.on(topics.HEAD, print),
        lambda: bus.announce("ground"),
        bus.watch_lives,
        lambda: bus.serve(topics.JOURNAL, no_answer),
        bus.poll,
    ):
        with pytest.raises(BusError, match="session closed"):
            act()
    with pytest.raises(BusError, match="session closed"):
        await bus.ask(topics.JOURNAL, "")
