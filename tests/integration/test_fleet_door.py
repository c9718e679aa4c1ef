"""Who is let in at a fleet's router: every other attempt is refused, and told in the router's log."""

from __future__ import annotations

import json
import signal
import socket
import ssl
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import zenoh

from faults.certificates import make_expired, make_foreign, make_revoked
from faults.fleet import (
    PATIENCE_S,
    POLL_S,
    REFUSED_S,
    Fleet,
    credentials_of,
    listening_as,
    running,
    speaking,
    state,
    told,
    try_to_open,
    wait_until,
)
from faults.ports import free_port
from protocol import topics
from protocol.bus import connect
from protocol.errors import BusError, NoReply
from protocol.messages import JumpHead, MissionPhase
from protocol.session import HANDSHAKE_S, Link, configuration

pytestmark = pytest.mark.light


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fleet]:
    with running(tmp_path_factory.mktemp("fleet")) as fleet:
        yield fleet


# --- who is not let in -----------------------------------------------------------------------------------------------


def without_certificate(fleet: Fleet, _: Path) -> dict[str, Any]:
    plain = told(fleet, credentials_of(fleet, "drone-1"))
    tls = plain["transport"]["link"]["tls"]
    del tls["connect_certificate"], tls["connect_private_key"]
    tls["enable_mtls"] = False
    return plain


def foreign(fleet: Fleet, folder: Path) -> dict[str, Any]:
    return told(fleet, make_foreign(folder, fleet.pki))


def expired(fleet: Fleet, folder: Path) -> dict[str, Any]:
    return told(fleet, make_expired(folder, fleet.pki))


def unencrypted(fleet: Fleet, _: Path) -> dict[str, Any]:
    return told(fleet, None, f"tcp/127.0.0.1:{fleet.port}")


@pytest.mark.parametrize(
    ("bad", "said"),
    [
        (without_certificate, "peer sent no certificates"),
        (foreign, "invalid peer certificate"),
        (expired, "invalid peer certificate: certificate expired"),
        (unencrypted, "refused: a connection: "),
    ],
)
def test_a_stranger_is_not_let_in(
    fleet: Fleet, tmp_path: Path, bad: Callable[[Fleet, Path], dict[str, Any]], said: str
) -> None:
    before = len(fleet.log())
    assert try_to_open(bad(fleet, tmp_path / "bad")) is None
    assert "refused: a connection: " in fleet.wait_for_log(said, after=before)


def test_a_process_does_not_trust_a_router_of_another_authority_or_another_name(fleet: Fleet, tmp_path: Path) -> None:
    """Who pretends to be the router gets no word from a drone."""
    with running(tmp_path) as other:
        mine = credentials_of(fleet, "drone-1")
        assert try_to_open(told(fleet, mine, other.endpoint)) is None
        named = told(fleet, mine, f"tls/127.0.0.2:{fleet.port}")
        assert try_to_open(named) is None
        other.wait_for_log("refused: a connection: received fatal alert")


def test_the_certificate_of_a_drone_is_not_taken_for_a_router(fleet: Fleet) -> None:
    port = free_port()
    drone = credentials_of(fleet, "drone-1")
    pretending = configuration("router", Link(f"tls/127.0.0.1:{port}", credentials=drone), "fleet")
    with zenoh.open(zenoh.Config.from_json5(json.dumps(pretending))):
        assert try_to_open(told(fleet, credentials_of(fleet, "drone-2"), f"tls/127.0.0.1:{port}")) is None


def test_a_certificate_that_was_revoked_opens_nothing_after_a_reload(tmp_path: Path) -> None:
    with running(tmp_path) as fleet:
        stolen = make_revoked(tmp_path / "thief", fleet.pki, "drone-2")
        before = len(fleet.log())
        with speaking(fleet, stolen):  # the router has not been told yet
            fleet.wait_for_log("drone-2.1 is there", after=before)
            fleet.router.send_signal(signal.SIGHUP)
            fleet.wait_for_log("certificates read again", after=before)
            fleet.wait_for_log("refused: drone-2.1", after=before)
            after = len(fleet.log())
        with speaking(fleet, stolen) as thief, listening_as(fleet, "ground") as heard:
            fleet.wait_for_log("drone-2.1", after=after)
            thief.put("drone/2/state", b"stolen")
            with speaking(fleet, credentials_of(fleet, "drone-1")) as drone:
                assert wait_until(lambda: drone.put("drone/1/state", b"own") or heard.has("drone/1/state"))
            assert set(heard.keys) == {"drone/1/state"}


# --- connections that are held open ----------------------------------------------------------------------------------

LORISES = 150
"""More than zenoh lets wait for their handshake at one time (``accept_pending``, 100)."""


def half_a_handshake(fleet: Fleet) -> socket.socket:
    """A connection that has begun to speak TLS and says no more."""
    incoming, outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
    context = ssl.create_default_context(cafile=str(fleet.pki / "ca.pem"))
    hello = context.wrap_bio(incoming, outgoing, server_hostname="127.0.0.1")
    with pytest.raises(ssl.SSLWantReadError):
        hello.do_handshake()
    way = socket.create_connection(("127.0.0.1", fleet.port))
    way.sendall(outgoing.read()[:50])
    return way


@pytest.mark.parametrize("begin", [lambda fleet: socket.create_connection(("127.0.0.1", fleet.port)), half_a_handshake])
def test_whoever_only_holds_connections_open_keeps_nobody_out(
    tmp_path: Path, begin: Callable[[Fleet], socket.socket]
) -> None:
    with running(tmp_path) as fleet, ExitStack() as stack:
        lorises = [stack.enter_context(begin(fleet)) for _ in range(LORISES)]
        began = time.monotonic()
        with speaking(fleet, credentials_of(fleet, "drone-1")) as drone, listening_as(fleet, "ground") as heard:
            assert wait_until(lambda: drone.put("drone/1/state", b"own") or heard.has("drone/1/state"))
        assert time.monotonic() - began < HANDSHAKE_S, "let in while all of them were still being waited for"
        fleet.wait_for_log("refused: a connection: Timeout during TLS handshake")
        lorises[0].settimeout(PATIENCE_S)
        assert lorises[0].recv(1) == b"", "closed"


# --- our own processes -----------------------------------------------------------------------------------------------


async def test_a_drones_process_hears_what_it_needs_and_asks_what_it_may(fleet: Fleet) -> None:
    before = len(fleet.log())
    phases: list[MissionPhase] = []
    async with connect(fleet.link("drone-1"), "fleet") as drone, connect(fleet.link("ground"), "fleet") as ground:
        drone.on(topics.PHASE, phases.append)
        drone.watch_lives()
        ground.announce("ground")
        assert await drone.until(lambda: "ground" in drone.alive, PATIENCE_S)
        for _ in range(round(PATIENCE_S / POLL_S)):
            ground.put(topics.PHASE, MissionPhase(phase="flying", reason=""))
            if await drone.until(lambda: bool(phases), POLL_S):
                break
        assert phases
        with pytest.raises(NoReply):
            await drone.ask(topics.JOURNAL, "from=0;to=1", timeout_s=REFUSED_S)
        drone.put(topics.STATE, state(1), 1)
    assert "refused" not in fleet.log()[before:]


async def test_a_client_that_is_not_let_in_says_where_to_look(fleet: Fleet, tmp_path: Path) -> None:
    link = Link(fleet.endpoint, credentials=make_foreign(tmp_path / "bad", fleet.pki))
    with pytest.raises(
        BusError, match=r"cannot reach tls/.*A router that refuses a certificate says so in its own log"
    ):
        async with connect(link, "fleet", timeout_s=0.1):
            pass


async def test_a_new_certificate_is_used_after_a_reload_and_a_damaged_register_changes_nothing(tmp_path: Path) -> None:
    with running(tmp_path) as fleet:
        register, mine = fleet.pki / "register.json", fleet.link("drone-1")
        whole = register.read_bytes()
        register.write_bytes(whole[:50])
        fleet.router.send_signal(signal.SIGHUP)
        fleet.wait_for_log("goes on with the register it has")
        heard: list[int] = []
        async with connect(mine, "fleet") as drone:
            drone.on(topics.HEAD, lambda head: heard.append(head.done))
            register.write_bytes(whole)
            fleet.router.send_signal(signal.SIGHUP)
            fleet.wait_for_log("certificates read again")
            async with connect(fleet.link("ground"), "fleet") as ground:
                for number in range(round(PATIENCE_S / POLL_S)):
                    ground.put(topics.HEAD, JumpHead(epoch=1, next_sequence=0, done=number, phase="flying"))
                    if await drone.until(lambda: bool(heard), POLL_S):
                        break
        assert heard, "the drone found back"
