"""The router as a process of its own, and what a bad link does to a client of it."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import subprocess
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from deploy.local import environment
from faults.datagrams import Loss, datagram_link
from faults.ports import free_port
from faults.proxy import Fault, Link, link
from protocol import topics
from protocol.bus import Bus, connect
from protocol.guard import ROOT
from protocol.messages import JumpHead

PATIENCE_S = 20.0
MISSION = "demo"
"""Its name is the namespace that the router is started with."""
Start = Callable[[str], "subprocess.Popen[str]"]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    started: list[subprocess.Popen[str]] = []

    def start(endpoint: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-P", "-m", "protocol.router", "--mission", str(ROOT / "missions" / "demo.toml")]
        router = subprocess.Popen(
            [*command, "--endpoint", endpoint, "--run", str(tmp_path), "--speed", "1"],
            stderr=subprocess.PIPE,
            text=True,
            env=environment(os.environ),
        )
        started.append(router)
        return router

    yield start
    for router in started:
        router.kill()
        router.communicate()


def head(number: int) -> JumpHead:
    return JumpHead(epoch=1, next_sequence=number, done=number, phase="flying")


async def heard_again(speaker: Bus, listener: Bus, heard: list[int]) -> None:
    """Say something until it is heard."""
    first = max(heard, default=0) + 1000
    for number in range(first, first + 1000):
        speaker.put(topics.HEAD, head(number))
        if await listener.until(lambda: bool(heard) and heard[-1] >= first, PATIENCE_S / 1000):
            return
    raise AssertionError("nothing came through")


def test_a_router_ends_on_sigterm(start: Start) -> None:
    router = start(f"tcp/127.0.0.1:{free_port()}")
    assert router.stderr is not None
    assert "listening at tcp/127.0.0.1:" in router.stderr.readline()

    router.send_signal(signal.SIGTERM)

    assert router.wait(PATIENCE_S) == 143


@pytest.mark.parametrize(("taken", "said"), [(True, "cannot listen at tcp/127.0.0.1:"), (False, "nonsense")])
def test_a_router_that_cannot_listen_is_bad_input_and_names_the_endpoint(start: Start, taken: bool, said: str) -> None:
    with socket.socket(socket.AF_INET) as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        router = start(f"tcp/127.0.0.1:{other.getsockname()[1]}" if taken else "nonsense")
        _, output = router.communicate(timeout=PATIENCE_S)

    assert router.returncode == 2
    assert said in output.splitlines()[-1]


def test_a_router_that_strangers_could_reach_does_not_start(start: Start) -> None:
    port = free_port()
    router = start(f"tcp/0.0.0.0:{port}")
    _, output = router.communicate(timeout=PATIENCE_S)

    assert router.returncode == 2
    assert f"tcp/0.0.0.0:{port}: would be open to other computers" in output.splitlines()[-1]
    assert f"write tls/0.0.0.0:{port} and set transport.credentials" in output


async def test_clients_find_each_other_again_after_the_router_was_killed(start: Start) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    router = start(endpoint)
    heard: list[int] = []
    async with connect(endpoint, MISSION) as speaker, connect(endpoint, MISSION) as listener:
        listener.on(topics.HEAD, lambda message: heard.append(message.done))
        listener.watch_lives()
        speaker.announce("ground")
        await heard_again(speaker, listener, heard)
        assert await listener.until(lambda: "ground" in listener.alive, PATIENCE_S)

        router.kill()
        router.wait()
        assert await listener.until(lambda: not listener.alive, PATIENCE_S)
        start(endpoint)

        assert await listener.until(lambda: "ground" in listener.alive, PATIENCE_S)
        await heard_again(speaker, listener, heard)


# --- links -----------------------------------------------------------------------------------------------------------


@asynccontextmanager
async def linked() -> AsyncIterator[tuple[Link, Bus, Bus, list[int]]]:
    """A link, who listens at its end, who speaks beside the router, and what was heard."""
    port = free_port()
    heard: list[int] = []
    async with (
        connect(f"tcp/127.0.0.1:{port}", MISSION, router=True) as speaker,
        link(port) as way,
        connect(way.endpoint, MISSION) as listener,
    ):
        listener.on(topics.HEAD, lambda message: heard.append(message.done))
        await heard_again(speaker, listener, heard)
        yield way, speaker, listener, heard


async def test_a_slow_link_delivers_everything_in_order_and_late() -> None:
    clock = asyncio.get_running_loop().time
    async with linked() as (way, speaker, listener, heard):
        way.set(Fault(delay_s=0.2, jitter_s=0.05))
        heard.clear()
        began = clock()
        for number in range(50):
            speaker.put(topics.HEAD, head(number))
        assert await listener.until(lambda: len(heard) == 50, PATIENCE_S)

    assert clock() - began >= 0.2
    assert heard == list(range(50))


async def test_a_black_hole_holds_what_is_said_until_it_heals() -> None:
    async with linked() as (way, speaker, listener, heard):
        way.set(Fault(held=("down",)))
        heard.clear()
        passed = way.passed_bytes
        for number in range(5):
            speaker.put(topics.HEAD, head(number))
        assert not await listener.until(lambda: bool(heard), 0.5)
        assert way.passed_bytes - passed < 100  # the listener's keep-alives go the other way

        way.heal()

        assert await listener.until(lambda: len(heard) == 5, PATIENCE_S)


async def test_a_client_behind_a_black_hole_is_missed_and_comes_back() -> None:
    async with linked() as (way, speaker, listener, heard):
        speaker.watch_lives()
        listener.announce("drone/1")
        assert await speaker.until(lambda: "drone/1" in speaker.alive, PATIENCE_S)

        way.set(Fault(held=("up", "down")))
        assert await speaker.until(lambda: "drone/1" not in speaker.alive, PATIENCE_S)
        way.heal()

        assert await speaker.until(lambda: "drone/1" in speaker.alive, PATIENCE_S)
        await heard_again(speaker, listener, heard)


async def test_a_narrow_link_passes_no_more_than_its_width() -> None:
    clock = asyncio.get_running_loop().time
    async with linked() as (way, speaker, listener, heard):
        way.set(Fault(bytes_per_s=20e3, narrow=("down",)))
        passed, began = way.passed_bytes, clock()
        for number in range(10_000, 10_400):
            speaker.put(topics.HEAD, head(number))
        for _ in range(int(PATIENCE_S)):  # a link as full as this one may drop any of them, the last as well
            speaker.put(topics.HEAD, head(10_400))
            if await listener.until(lambda: heard[-1] == 10_400, 1.0):
                break
        assert heard[-1] == 10_400
        took_s = clock() - began

    assert (way.passed_bytes - passed) / took_s < 21e3


async def test_a_connection_that_is_reset_is_made_anew() -> None:
    async with linked() as (way, speaker, listener, heard):
        before = way.connections
        way.reset()
        await heard_again(speaker, listener, heard)
        assert way.connections > before


async def test_lost_and_late_datagrams_are_lost_messages_and_repeated_ones_are_not_heard_twice() -> None:
    port = free_port(socket.SOCK_DGRAM)
    heard: list[int] = []
    async with (
        connect(f"udp/127.0.0.1:{port}", MISSION, router=True) as speaker,
        datagram_link(port) as way,
        connect(way.endpoint, MISSION) as listener,
    ):
        listener.on(topics.HEAD, lambda message: heard.append(message.done))
        await heard_again(speaker, listener, heard)
        heard.clear()
        way.set(Loss(lost=0.1, late=0.1, repeated=0.2))
        for number in range(300):
            speaker.put(topics.HEAD, head(number))
            await asyncio.sleep(0.002)  # a datagram each
        way.heal()
        await heard_again(speaker, listener, heard)

    heard = [number for number in heard if number < 300]
    assert 150 < len(heard) < 290
    assert heard == sorted(set(heard))
