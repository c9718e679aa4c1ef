"""A fleet's router as a real process, certificates, and zenoh sessions that no rule of our own holds back."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import zenoh

from deploy.local import environment
from faults.certificates import make_credentials
from faults.ports import free_port
from protocol import topics
from protocol.credentials import Credentials, load_credentials
from protocol.messages import DroneState, ReplicaState
from protocol.session import Link, configuration
from protocol.topics import alive_key

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


@contextmanager
def listening_as(fleet: Fleet, identity: str) -> Iterator[Heard]:
    heard = Heard([])
    with speaking(fleet, credentials_of(fleet, identity)) as session:
        kept = session.declare_subscriber(topics.STATE.of("*"), heard.note)
        yield heard
        del kept


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
