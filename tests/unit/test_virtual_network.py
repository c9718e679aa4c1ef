"""The network that random faults are tried on behaves as zenoh was measured to, in time that nobody waits for."""

from __future__ import annotations

import asyncio
import random
import threading
from collections.abc import Awaitable, Callable
from typing import TypeVar
from unittest.mock import patch

import pytest
import zenoh

from faults.garbage import Rubbish, clock_ahead, is_message
from faults.link import BUFFER_BYTES, Faults
from faults.network import DEATH_S, LEASE_S, RECONNECT_S, Network
from faults.session import Ring, Session
from faults.virtual_loop import EXECUTOR_S, Process, StandStill, run
from protocol import topics
from protocol.bus import Bus
from protocol.errors import BusError, NoReply
from protocol.messages import JournalPage, JumpHead, MissionPhase, Tick
from protocol.wire import decode, encode

T = TypeVar("T")
SOON_S = 0.1
"""Longer than any message takes on links that nothing is wrong with."""


class Peer:
    """One process with its bus, and what it heard."""

    def __init__(self, network: Network, role: str, *, lossless: bool = False) -> None:
        self.process = Process(role)
        self.session: Session = network.session(self.process)
        self.bus: Bus = self.process.call(lambda: Bus(self.session, lossless=lossless))  # type: ignore[arg-type]
        self.heard: list[int] = []
        self.process.call(self.bus.on, topics.HEAD, lambda message: self.heard.append(message.done))
        self.process.call(self.bus.watch_lives)
        self.process.call(self.bus.announce, role)

    def put(self, *numbers: int) -> None:
        for number in numbers:
            self.process.call(self.bus.put, topics.HEAD, head(number))


def head(done: int) -> JumpHead:
    return JumpHead(epoch=1, next_sequence=0, done=done, phase="flying")


def now_s() -> float:
    return asyncio.get_running_loop().time()


def trial(body: Callable[[Network], Awaitable[T]], seed: int = 1) -> T:
    """Run ``body`` on a new network."""

    async def main() -> T:
        dice = random.Random(seed)
        return await body(Network(dice, Rubbish(dice)))

    with patch.object(zenoh.handlers, "RingChannel", Ring):
        return run(main())


# --- time and processes ----------------------------------------------------------------------------------------------


def test_timers_pass_in_their_order_without_anybody_waiting() -> None:
    passed: list[tuple[str, float]] = []

    async def sleep(name: str, seconds: float) -> None:
        await asyncio.sleep(seconds)
        passed.append((name, round(now_s(), 6)))

    async def main() -> None:
        await asyncio.gather(sleep("late", 3600.0), sleep("early", 0.5), sleep("next", 0.5))

    run(main())
    assert passed == [("early", 0.5), ("next", 0.5), ("late", 3600.0)]


def test_what_runs_in_an_executor_takes_its_time_and_no_thread() -> None:
    async def main() -> tuple[str, float]:
        return await asyncio.to_thread(lambda: threading.current_thread().name), now_s()

    name, ended_s = run(main())
    assert name == threading.main_thread().name
    assert ended_s == pytest.approx(EXECUTOR_S)

    async def raise_it() -> None:
        await asyncio.to_thread(lambda: 1 // 0)

    with pytest.raises(ZeroDivisionError):
        run(raise_it())


def test_a_thread_is_refused() -> None:
    async def main() -> None:
        threading.Thread(target=print, name="sneaky").start()

    with pytest.raises(AssertionError, match="sneaky: threads have no place in virtual time"):
        run(main())


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_waiting_for_ever_and_running_in_a_circle_are_noticed() -> None:
    async def wait() -> None:
        await asyncio.Event().wait()

    async def circle() -> None:
        while True:  # noqa: ASYNC110 - an event would be the cure
            await asyncio.sleep(0)

    with pytest.raises(StandStill, match="no timer is set"):
        run(wait())
    with pytest.raises(StandStill, match="turns of the loop"):
        run(circle())


def test_a_stopped_process_does_late_what_came_due_and_a_killed_one_never() -> None:
    done: list[tuple[str, float]] = []

    async def count(name: str) -> None:
        try:
            for _ in range(4):
                await asyncio.sleep(1.0)
                done.append((name, round(now_s(), 6)))
        finally:
            done.append((f"{name} ended", round(now_s(), 6)))

    async def main() -> None:
        stopped, killed = Process("stopped"), Process("killed")
        stopped.start(count("stopped"))
        killed.start(count("killed"))
        await asyncio.sleep(1.5)
        stopped.stop()
        killed.kill()
        await asyncio.sleep(2.0)
        assert done == [("stopped", 1.0), ("killed", 1.0)]
        stopped.resume()
        await asyncio.sleep(6.5)
        assert done[2:] == [("stopped", 3.5), ("stopped", 4.5), ("stopped", 5.5), ("stopped ended", 5.5)]
        await killed.bury()
        assert done[-1] == ("killed ended", 10.0)

    run(main())


# --- messages --------------------------------------------------------------------------------------------------------


def test_messages_arrive_in_order_at_all_who_listen_but_not_at_their_sender() -> None:
    async def body(network: Network) -> None:
        one, other, third = (Peer(network, role) for role in ("drone/1", "drone/2", "ground"))
        one.put(*range(100))
        await asyncio.sleep(SOON_S)
        assert other.heard == third.heard == list(range(100))
        assert not one.heard

    trial(body)


def test_the_same_seed_gives_the_same_bytes_and_another_one_others() -> None:
    async def body(network: Network) -> str:
        one, other = Peer(network, "drone/1"), Peer(network, "drone/2")
        one.session.up.faults = Faults(loss=0.2, jitter_s=0.05)
        other.session.down.faults = Faults(garble=0.2)
        one.put(*range(200))
        await asyncio.sleep(1.0)
        return network.digest

    assert trial(body, seed=3) == trial(body, seed=3) != trial(body, seed=4)


def test_a_lossy_link_loses_its_share_but_nothing_of_a_lossless_bus() -> None:
    async def body(network: Network) -> None:
        lossy, lossless, listener = (
            Peer(network, "drone/1"),
            Peer(network, "drone/2", lossless=True),
            Peer(network, "ground"),
        )
        for peer in (lossy, lossless):
            peer.session.up.faults = Faults(loss=0.3)
        for number in range(1000):
            lossless.put(number)
            lossy.put(1000 + number)
            await asyncio.sleep(0.001)
        await asyncio.sleep(SOON_S)
        assert [number for number in listener.heard if number < 1000] == list(range(1000))
        assert 600 < sum(number >= 1000 for number in listener.heard) < 800
        assert network.counts["lost"] == 2000 - len(listener.heard)

    trial(body)


def test_a_slow_link_delays_a_shaky_one_reorders_and_a_stuttering_one_repeats() -> None:
    async def body(network: Network) -> None:
        slow, shaky, stuttering, listener = (
            Peer(network, role) for role in ("drone/1", "drone/2", "drone/3", "ground")
        )
        slow.session.up.faults = Faults(delay_s=0.3)
        shaky.session.up.faults = Faults(jitter_s=0.1)
        stuttering.session.up.faults = Faults(duplicate=1.0)
        slow.put(1)
        shaky.put(*range(100, 150))
        stuttering.put(1000)
        await asyncio.sleep(0.2)
        assert listener.heard.count(1000) == 2
        overtaking = [number for number in listener.heard if 100 <= number < 150]
        assert sorted(overtaking) == list(range(100, 150)) != overtaking
        assert 1 not in listener.heard
        await asyncio.sleep(0.2)
        assert 1 in listener.heard

    trial(body)


def test_a_narrow_link_holds_what_fits_its_buffers_and_drops_the_rest() -> None:
    async def body(network: Network) -> None:
        narrow, listener = Peer(network, "drone/1"), Peer(network, "ground")
        size = len(encode(head(1000)))
        sent = 3 * BUFFER_BYTES // size
        narrow.session.up.faults = Faults(bytes_per_s=BUFFER_BYTES / 10)
        for number in range(1000, 1000 + sent):
            narrow.put(number)
        await asyncio.sleep(5.0)
        assert len(listener.heard) == pytest.approx(BUFFER_BYTES / 2 / size, rel=0.01)
        await asyncio.sleep(10.0)
        assert len(listener.heard) == pytest.approx(BUFFER_BYTES / size, abs=2)
        assert network.counts["no room"] == sent - len(listener.heard)

    trial(body)


def test_rubbish_is_refused_and_never_taken_for_a_message() -> None:
    dice = random.Random(5)
    rubbish = Rubbish(dice)
    payload = encode(head(7))
    made = [rubbish("phi/head", payload) for _ in range(2000)]
    assert not any(is_message("phi/head", bytes_) for bytes_ in made)
    assert is_message("phi/head", payload)
    assert not is_message("nobody/knows", payload)

    async def body(network: Network) -> None:
        one, other = Peer(network, "drone/1"), Peer(network, "drone/2")
        one.session.up.faults = Faults(garble=1.0)
        one.put(1, 2, 3)
        await asyncio.sleep(SOON_S)
        assert not other.heard
        assert other.bus.statistics.refused == {"phi/head": 3}

    trial(body)


def test_a_clock_ahead_changes_ticks_and_nothing_else() -> None:
    hears = clock_ahead(3)
    tick = Tick(tick=5, time_s=0.25, lockstep=False, live=(), vehicles=(), jump_epoch=0, next_jump=0, keyframes=0)
    assert decode(Tick, hears("clock/tick", encode(tick))) == tick.model_copy(update={"tick": 8})
    assert hears("clock/tick", b"rubbish") == b"rubbish"
    assert hears("phi/head", encode(head(1))) == encode(head(1))


def test_a_ring_keeps_the_newest() -> None:
    async def body(network: Network) -> None:
        one, other = Peer(network, "drone/1"), Peer(network, "drone/2")
        reasons: list[str] = []
        other.process.call(
            lambda: other.bus.on(topics.PHASE, lambda message: reasons.append(message.reason), wakes=False)
        )
        room = topics.PHASE.queue
        await asyncio.sleep(SOON_S)
        for number in range(room + 5):
            one.process.call(one.bus.put, topics.PHASE, MissionPhase(phase="flying", reason=str(number)))
        await asyncio.sleep(SOON_S)
        assert not reasons
        other.process.call(other.bus.poll)
        assert reasons == [str(number) for number in range(5, room + 5)]

    trial(body)


# --- lives, partitions, stops and deaths -----------------------------------------------------------------------------


def test_lives_are_known_also_those_from_before() -> None:
    async def body(network: Network) -> None:
        early = Peer(network, "ground")
        await asyncio.sleep(1.0)
        late = Peer(network, "drone/1")
        await asyncio.sleep(SOON_S)
        assert early.bus.alive == late.bus.alive == {"ground", "drone/1"}
        await late.bus.close()
        await asyncio.sleep(SOON_S)
        assert early.bus.alive == {"ground"}
        with pytest.raises(BusError, match="session closed"):
            late.put(1)

    trial(body)


def test_a_short_black_hole_only_delays() -> None:
    async def body(network: Network) -> None:
        one, other = Peer(network, "drone/1"), Peer(network, "drone/2")
        await asyncio.sleep(SOON_S)
        network.black_hole(one.session, active=True)
        one.put(1, 2)
        other.put(3)
        await asyncio.sleep(1.0)
        assert not one.heard
        assert not other.heard
        network.black_hole(one.session, active=False)
        await asyncio.sleep(SOON_S)
        assert (one.heard, other.heard) == ([3], [1, 2])
        assert one.bus.alive == other.bus.alive == {"drone/1", "drone/2"}

    trial(body)


def test_a_long_black_hole_ends_the_connection_which_comes_back_by_itself() -> None:
    async def body(network: Network) -> None:
        one, other, third = (Peer(network, role) for role in ("drone/1", "drone/2", "ground"))
        await asyncio.sleep(SOON_S)
        network.black_hole(one.session, active=True)
        one.put(1)
        await asyncio.sleep(0.7 * LEASE_S)
        assert "drone/1" in other.bus.alive
        await asyncio.sleep(0.35 * LEASE_S)
        assert other.bus.alive == third.bus.alive == {"drone/2", "ground"}
        assert one.bus.alive == set(), "whoever has lost the router knows of nobody"
        one.put(2)
        other.put(3)
        network.black_hole(one.session, active=False)
        await asyncio.sleep(RECONNECT_S - 0.01)
        assert "drone/1" not in other.bus.alive
        await asyncio.sleep(SOON_S)
        assert one.bus.alive == other.bus.alive == {"drone/1", "drone/2", "ground"}
        assert (one.heard, other.heard, third.heard) == ([], [], [3])
        one.put(4)
        other.put(5)
        await asyncio.sleep(SOON_S)
        assert (one.heard, other.heard) == ([5], [4])

    trial(body)


def test_a_reset_connection_is_missed_at_once_and_made_anew() -> None:
    async def body(network: Network) -> None:
        one, other = Peer(network, "drone/1"), Peer(network, "drone/2")
        await asyncio.sleep(SOON_S)
        network.reset(one.session)
        await asyncio.sleep(SOON_S)
        assert (one.bus.alive, other.bus.alive) == (set(), {"drone/2"})
        await asyncio.sleep(RECONNECT_S)
        assert one.bus.alive == other.bus.alive == {"drone/1", "drone/2"}

    trial(body)


def test_a_stopped_process_hears_all_that_its_buffers_hold_when_it_goes_on() -> None:
    async def body(network: Network) -> None:
        one, other = Peer(network, "drone/1"), Peer(network, "drone/2")
        await asyncio.sleep(SOON_S)
        network.stop(one.session)
        size = len(encode(head(1000)))
        sent = 2 * BUFFER_BYTES // size
        for number in range(1000, 1000 + sent):
            other.put(number)
            await asyncio.sleep(0.0001)
        await asyncio.sleep(SOON_S)
        assert not one.heard
        network.resume(one.session)
        await asyncio.sleep(SOON_S)
        held = min(BUFFER_BYTES // size, topics.HEAD.queue)
        assert len(one.heard) == held
        assert network.counts["no room"] == sent - BUFFER_BYTES // size

        network.stop(one.session)
        await asyncio.sleep(LEASE_S)
        assert other.bus.alive == {"drone/2"}
        network.resume(one.session)
        await asyncio.sleep(RECONNECT_S + SOON_S)
        assert one.bus.alive == other.bus.alive == {"drone/1", "drone/2"}

    trial(body)


def test_a_killed_process_is_missed_at_once_and_says_nothing_more() -> None:
    async def body(network: Network) -> None:
        one, other = Peer(network, "drone/1"), Peer(network, "drone/2")

        async def talk() -> None:
            try:
                await asyncio.sleep(1.0)
                one.put(1)
                await asyncio.sleep(1.0)
            finally:
                one.put(2)

        one.process.start(talk())
        await asyncio.sleep(1.5)
        network.kill(one.session)
        await asyncio.sleep(DEATH_S + SOON_S)
        assert other.bus.alive == {"drone/2"}
        await asyncio.sleep(2.0)
        await one.process.bury()
        await asyncio.sleep(SOON_S)
        assert other.heard == [1]

    trial(body)


def test_whoever_is_killed_while_putting_has_not_put() -> None:
    async def body(network: Network) -> None:
        one, other = Peer(network, "drone/1"), Peer(network, "drone/2")
        await asyncio.sleep(SOON_S)
        network.taps.append(lambda session, _key, payload: payload == encode(head(3)) and network.kill(session))
        one.put(2, 3, 4)
        await asyncio.sleep(SOON_S)
        assert other.heard == [2]
        assert other.bus.alive == {"drone/2"}

    trial(body)


# --- questions -------------------------------------------------------------------------------------------------------


async def _page(parameters: dict[str, str]) -> JournalPage:
    await asyncio.sleep(float(parameters.get("after", 0.0)))
    return JournalPage(epoch=1, first_sequence=0, next_sequence=int(parameters["from"]), jumps=())


def test_a_question_is_answered_by_who_serves_it() -> None:
    async def body(network: Network) -> None:
        server, asker = Peer(network, "ground"), Peer(network, "drone/1")
        server.process.call(server.bus.serve, topics.JOURNAL, _page)
        page = await asker.process.start(asker.bus.ask(topics.JOURNAL, "from=7"))
        assert page.next_sequence == 7
        assert now_s() < SOON_S

    trial(body)


def test_a_question_that_nobody_serves_ends_at_once_and_one_to_a_silent_server_by_its_time_out() -> None:
    async def body(network: Network) -> None:
        server, asker = Peer(network, "ground"), Peer(network, "drone/1")

        async def refused_after() -> float:
            began = now_s()
            with pytest.raises(NoReply):
                await asker.process.start(asker.bus.ask(topics.JOURNAL, "from=7;after=60", timeout_s=1.0))
            return now_s() - began

        assert await refused_after() < SOON_S, "nobody serves it"
        server.process.call(server.bus.serve, topics.JOURNAL, _page)
        assert await refused_after() == pytest.approx(1.0), "the answer takes too long"
        network.stop(server.session)
        assert await refused_after() == pytest.approx(1.0), "the server is stopped"
        network.resume(server.session)
        asyncio.get_running_loop().call_later(0.5, network.kill, server.session)
        assert await refused_after() == pytest.approx(0.5, abs=SOON_S), "the server died"
        await server.process.bury()
        network.black_hole(asker.session, active=True)
        await asyncio.sleep(LEASE_S)
        assert await refused_after() < SOON_S, "there is no connection"

    trial(body)


def test_a_lost_answer_is_noticed_by_the_time_out() -> None:
    async def body(network: Network) -> None:
        server, asker = Peer(network, "ground"), Peer(network, "drone/1")
        server.process.call(server.bus.serve, topics.JOURNAL, _page)
        server.session.up.faults = Faults(loss=1.0)
        with pytest.raises(NoReply):
            await asker.process.start(asker.bus.ask(topics.JOURNAL, "from=7", timeout_s=1.0))
        assert now_s() == pytest.approx(1.0)
        server.session.up.faults = Faults(loss=0.0)
        assert (await asker.process.start(asker.bus.ask(topics.JOURNAL, "from=7"))).next_sequence == 7

    trial(body)
