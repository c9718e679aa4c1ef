"""Who is let in at a fleet's router, and what those may do: every attempt is refused, and told in the router's log."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
import ssl
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
import zenoh

from deploy.local import environment
from faults.certificates import make_credentials, make_expired, make_foreign, make_revoked
from faults.ports import free_port
from protocol import topics
from protocol.bus import Bus, connect
from protocol.credentials import Credentials, load_credentials
from protocol.errors import BusError, NoReply
from protocol.messages import DroneState, Event, JumpHead, MissionPhase, ReplicaState, Setpoint
from protocol.session import HANDSHAKE_S, Link, configuration
from protocol.topics import Topic, alive_key
from protocol.wire import MAX_MESSAGE_BYTES, Message, encode

pytestmark = pytest.mark.light

PATIENCE_S = 10.0
REFUSED_S = 1.0
"""After so long without a session a client was refused; one that is let in has it within 50 ms."""
POLL_S = 0.02
SPACE = "covrecon/fleet"
MISSION = """
name = "fleet"
[transport]
endpoint = "tls/127.0.0.1:{port}"
credentials = "pki"
[[drones]]
id = 1
start = [0.0, 0.0, 2.0, 0.0, 1.5]
[[drones]]
id = 2
start = [2.0, 0.0, 2.0, 0.0, 1.5]
"""


@dataclass
class Fleet:
    folder: Path
    port: int
    router: subprocess.Popen[bytes]

    @property
    def pki(self) -> Path:
        return self.folder / "pki"

    @property
    def endpoint(self) -> str:
        return f"tls/127.0.0.1:{self.port}"

    def link(self, identity: str) -> Link:
        return Link(self.endpoint, credentials=load_credentials(self.pki, identity, now=datetime.now(UTC)))

    def log(self) -> str:
        return (self.folder / "router.log").read_text()

    def wait_for_log(self, text: str, *, after: int = 0) -> str:
        deadline = time.monotonic() + PATIENCE_S
        while text not in self.log()[after:]:
            assert time.monotonic() < deadline, f"{text!r} is not in the router's log:\n{self.log()[after:]}"
            assert self.router.poll() is None
            time.sleep(POLL_S)
        return self.log()[after:]


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fleet]:
    with running(tmp_path_factory.mktemp("fleet")) as fleet:
        yield fleet


@contextmanager
def running(folder: Path) -> Iterator[Fleet]:
    make_credentials(folder / "pki", drones=(1, 2), operators=("anna",), hosts=("127.0.0.1",))
    port = free_port()
    (folder / "fleet.toml").write_text(MISSION.format(port=port))
    command = [sys.executable, "-P", "-m", "protocol.router", "--mission", str(folder / "fleet.toml")]
    with (folder / "router.log").open("wb") as log:
        router = subprocess.Popen(
            [*command, "--run", str(folder)], stdout=log, stderr=subprocess.STDOUT, env=environment(os.environ)
        )
    try:
        fleet = Fleet(folder, port, router)
        fleet.wait_for_log("listening at")
        yield fleet
    finally:
        router.kill()
        router.wait()


def try_to_open(told: Mapping[str, Any]) -> zenoh.Session | None:
    """A session as its configuration asks for; None if nobody let it in."""
    told = {**told, "connect": {**told["connect"], "timeout_ms": int(REFUSED_S * 1000)}}
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(told)))
    except zenoh.ZError:
        return None


def told(fleet: Fleet, credentials: Credentials | None, endpoint: str = "") -> dict[str, Any]:
    return configuration("client", Link(endpoint or fleet.endpoint, credentials=credentials), "fleet")


@contextmanager
def speaking(fleet: Fleet, credentials: Credentials) -> Iterator[zenoh.Session]:
    """zenoh itself, which no rule of our own holds back."""
    session = try_to_open(told(fleet, credentials))
    assert session is not None, "not let in"
    with session:
        yield session


def credentials_of(fleet: Fleet, identity: str) -> Credentials:
    found = fleet.link(identity).credentials
    assert found is not None
    return found


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


# --- what those may do who are let in --------------------------------------------------------------------------------


@dataclass
class Heard:
    """All that reaches the ground station's side of the bus, whatever its key."""

    keys: list[str]

    def note(self, sample: zenoh.Sample) -> None:
        self.keys.append(str(sample.key_expr))

    def has(self, key: str) -> bool:
        return key in self.keys


@contextmanager
def listening(fleet: Fleet) -> Iterator[tuple[Heard, dict[str, zenoh.Session]]]:
    """Sessions of each kind of process that hear all that they may, and what they heard."""
    heard = Heard([])
    with ExitStack() as stack:
        sessions = {
            identity: stack.enter_context(speaking(fleet, credentials_of(fleet, identity)))
            for identity in ("ground", "sim", "drone-2", "operator-anna")
        }
        kept: list[object] = []
        for session in sessions.values():
            kept += [
                session.declare_subscriber(topic.of("*"), heard.note, allowed_origin=zenoh.Locality.REMOTE)
                for topic in topics.TOPICS
            ]
            kept.append(session.liveliness().declare_subscriber(alive_key("**"), heard.note))
        yield heard, sessions
        del kept


def wait_until(condition: Callable[[], bool]) -> bool:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(POLL_S)
    return True


FOREIGN_KEYS = (
    topics.STATE.of(2),
    topics.EVENT.of(2),
    topics.SETPOINT.of(2),
    topics.KEYFRAME.of(2),
    topics.JUMP.of(""),
    topics.HEAD.of(""),
    topics.DIGEST.of(""),
    topics.PHASE.of(""),
    topics.TICK.of(""),
    topics.STATUS.of(""),
    topics.GROUND_EVENT.of(""),
    "drone/9/state",
    "anything/else",
)


def test_a_drone_writes_its_own_keys_and_nobody_elses(fleet: Fleet) -> None:
    before = len(fleet.log())
    with listening(fleet) as (heard, _), speaking(fleet, credentials_of(fleet, "drone-1")) as drone:
        for key in (*FOREIGN_KEYS, "drone/*/state", "**"):
            drone.put(key, b"forged")
            fleet.wait_for_log(f"refused: drone-1.1 may not put {key}", after=before)
        assert wait_until(lambda: drone.put("drone/1/state", b"own") or heard.has("drone/1/state"))
        assert set(heard.keys) == {"drone/1/state"}, "what came before has arrived too, if it ever will"


def test_a_drone_passes_for_nobody_else(fleet: Fleet) -> None:
    before = len(fleet.log())
    with listening(fleet) as (heard, _), speaking(fleet, credentials_of(fleet, "drone-1")) as drone:
        tokens = [drone.liveliness().declare_token(alive_key(role)) for role in ("drone/2", "ground", "sim", "drone/1")]
        for role in ("drone/2", "ground", "sim"):
            fleet.wait_for_log(f"refused: drone-1.1 may not pass for {alive_key(role)}", after=before)
        assert wait_until(lambda: heard.has(alive_key("drone/1")))
        assert set(heard.keys) == {alive_key("drone/1")}
        del tokens


@pytest.mark.parametrize("topic", [topics.BLOCKS, topics.JOURNAL, topics.MAP, topics.COMMAND], ids=lambda t: t.key)
def test_a_drone_gives_no_answers_in_the_ground_stations_place(fleet: Fleet, topic: Topic[Message]) -> None:
    """Neither snapshots of phi nor jumps nor acknowledgements of commands."""
    before = len(fleet.log())
    with (
        speaking(fleet, credentials_of(fleet, "drone-1")) as drone,
        speaking(fleet, credentials_of(fleet, "operator-anna")) as asker,
    ):
        forged = drone.declare_queryable(topic.key, lambda query: query.reply(topic.key, b"forged"))
        fleet.wait_for_log(f"refused: drone-1.1 may not answer to {topic.key}", after=before)
        assert [reply.ok for reply in asker.get(topic.key, timeout=REFUSED_S)] == []
        del forged


def test_a_drone_answers_for_its_own_phi_alone(fleet: Fleet) -> None:
    before = len(fleet.log())
    with (
        speaking(fleet, credentials_of(fleet, "drone-1")) as drone,
        speaking(fleet, credentials_of(fleet, "ground")) as ground,
    ):
        kept = [drone.declare_queryable(f"drone/{i}/phi", _answer_with(f"drone/{i}/phi")) for i in (1, 2)]
        fleet.wait_for_log("refused: drone-1.1 may not answer to drone/2/phi", after=before)
        assert wait_until(lambda: [r for r in ground.get("drone/1/phi", timeout=REFUSED_S) if r.ok] != [])
        assert [r for r in ground.get("drone/2/phi", timeout=REFUSED_S) if r.ok] == []
        del kept


def _answer_with(key: str) -> Callable[[zenoh.Query], None]:
    return lambda query: query.reply(key, b"x")


@pytest.mark.parametrize("identity", ["drone-1", "sim"])
def test_only_operators_command(fleet: Fleet, identity: str) -> None:
    before = len(fleet.log())
    with (
        speaking(fleet, credentials_of(fleet, "ground")) as ground,
        speaking(fleet, credentials_of(fleet, identity)) as other,
        speaking(fleet, credentials_of(fleet, "operator-anna")) as operator,
    ):
        asked: list[str] = []
        kept = ground.declare_queryable(
            "command/request", lambda query: (asked.append(str(query.parameters)), query.reply("command/request", b"x"))
        )
        list(other.get("command/request?id=1;verb=abort", timeout=REFUSED_S))
        fleet.wait_for_log(f"refused: {identity}.1 may not ask command/request", after=before)
        assert wait_until(lambda: list(operator.get("command/request?id=2;verb=pause", timeout=REFUSED_S)) != [])
        assert set(asked) == {"id=2;verb=pause"}
        del kept


def test_an_operator_commands_and_watches_but_writes_nothing(fleet: Fleet) -> None:
    before = len(fleet.log())
    with listening(fleet) as (heard, sessions), speaking(fleet, credentials_of(fleet, "drone-1")) as drone:
        for key in (*FOREIGN_KEYS, "drone/1/state"):
            sessions["operator-anna"].put(key, b"forged")
            fleet.wait_for_log(f"refused: operator-anna.1 may not put {key}", after=before)
        assert wait_until(lambda: drone.put("drone/1/event", b"own") or heard.has("drone/1/event"))
        assert set(heard.keys) == {"drone/1/event"}


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


@contextmanager
def listening_as(fleet: Fleet, identity: str) -> Iterator[Heard]:
    heard = Heard([])
    with speaking(fleet, credentials_of(fleet, identity)) as session:
        kept = session.declare_subscriber(topics.STATE.of("*"), heard.note)
        yield heard
        del kept


# --- messages that are let through and refused where they arrive -----------------------------------------------------

REPLICA = ReplicaState(tick=0, epoch=0, next_jump=0, missing=0, repaired=0, lost=0)
ZERO = (0.0, 0.0, 0.0, 0.0, 0.0)


def state(drone: int) -> DroneState:
    return DroneState(
        drone=drone,
        tick=1,
        pose=ZERO,
        velocity=ZERO,
        battery=1.0,
        mode="flying",
        obeyed=7,
        importance=1.0,
        replica=REPLICA,
        control=None,
    )


async def put_until(sender: zenoh.Session, key: str, payload: bytes, bus: Bus, condition: Callable[[], bool]) -> bool:
    for _ in range(round(PATIENCE_S / POLL_S)):
        sender.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)
        if await bus.until(condition, POLL_S):
            return True
    return False


@pytest.mark.parametrize(
    ("topic", "forged", "said"),
    [
        (topics.STATE, encode(state(2)), "drone/1/state: message 1 refused: state: speaks for drone/2"),
        (
            topics.EVENT,
            encode(Event(source="drone/2", tick=1, level="error", kind="battery", text="empty")),
            "drone/1/event: message 1 refused: event: speaks for drone/2",
        ),
        (
            topics.SETPOINT,
            encode(Setpoint(drone=2, tick=1, velocity=ZERO)),
            "drone/1/setpoint: message 1 refused: setpoint: speaks for drone/2",
        ),
        (
            topics.STATE,
            bytes(100_000),
            "drone/1/state: message 1 refused: state: 100000 bytes exceed the limit of 16384",
        ),
    ],
)
async def test_a_drone_acknowledges_and_speaks_for_no_other_under_its_own_key(
    fleet: Fleet, caplog: pytest.LogCaptureFixture, topic: Topic[Message], forged: bytes, said: str
) -> None:
    reader = "sim" if topic is topics.SETPOINT else "ground"
    heard: list[Message] = []
    async with connect(fleet.link(reader), "fleet") as bus:
        bus.on(topic, heard.append)
        with speaking(fleet, credentials_of(fleet, "drone-1")) as drone:
            refused = bus.statistics.refused
            assert await put_until(drone, topic.of(1), forged, bus, lambda: refused.total() > 0)
    assert heard == []
    assert said in caplog.text


async def test_a_message_beyond_all_limits_costs_its_sender_the_message_and_nobody_anything_else(fleet: Fleet) -> None:
    heard: list[DroneState] = []
    async with connect(fleet.link("ground"), "fleet") as bus:
        bus.on(topics.STATE, heard.append)
        with speaking(fleet, credentials_of(fleet, "drone-1")) as drone:
            before = resident_bytes(fleet.router.pid)
            for _ in range(3):
                await asyncio.to_thread(
                    drone.put,
                    "drone/1/state",
                    bytes(4 * MAX_MESSAGE_BYTES),
                    congestion_control=zenoh.CongestionControl.BLOCK,
                )
            assert await put_until(drone, "drone/1/state", encode(state(1)), bus, lambda: bool(heard))
            grown = resident_bytes(fleet.router.pid) - before
    assert {message.drone for message in heard} == {1}
    assert grown < 3 * MAX_MESSAGE_BYTES


def resident_bytes(pid: int) -> int:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


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
        fleet.wait_for_log("goes on with the certificates it has")
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
