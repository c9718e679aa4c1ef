"""What those may do who are let in at a fleet's router: each its own part; any other attempt is told in its log."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zenoh

from faults.fleet import (
    PATIENCE_S,
    POLL_S,
    REFUSED_S,
    ZERO,
    Fleet,
    credentials_of,
    listening,
    running,
    speaking,
    state,
    wait_until,
)
from protocol import topics
from protocol.bus import Bus, connect
from protocol.messages import DroneState, Event, Setpoint
from protocol.topics import Topic, alive_key
from protocol.wire import MAX_MESSAGE_BYTES, Message, encode

pytestmark = pytest.mark.light


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fleet]:
    with running(tmp_path_factory.mktemp("fleet")) as fleet:
        yield fleet


# --- what those may do who are let in --------------------------------------------------------------------------------


FOREIGN_KEYS = (
    topics.STATE.of(2),
    topics.EVENT.of(2),
    topics.SETPOINT.of(2),
    topics.KEYFRAME.of(2),
    topics.JUMP.of(""),
    topics.HEAD.of(""),
    topics.DIGEST.of(""),
    topics.FREE.of(""),
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


# --- messages that are let through and refused where they arrive -----------------------------------------------------


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
