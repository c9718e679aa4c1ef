"""More than one router: two of one site, of which either may die, and a tree of sites."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from deploy.local import environment
from faults.certificates import make_credentials
from faults.ports import free_port
from protocol import topics
from protocol.bus import Bus, connect
from protocol.credentials import load_credentials
from protocol.messages import Event, JumpHead
from protocol.mission_file import load_mission
from protocol.session import Link
from protocol.topics import Topic
from protocol.wire import Message

pytestmark = pytest.mark.light

PATIENCE_S = 20.0
POLL_S = 0.05
MISSION = """
name = "sites"
[transport]
endpoint = "{endpoint}"
uplinks = {uplinks}
credentials = "pki"
[[drones]]
id = 1
start = [0.0, 0.0, 2.0, 0.0, 1.5]
"""
Start = Callable[..., "subprocess.Popen[bytes]"]


@pytest.fixture
def pki(tmp_path: Path) -> Path:
    make_credentials(tmp_path / "pki", drones=(1,))
    return tmp_path / "pki"


@pytest.fixture
def start(tmp_path: Path, pki: Path) -> Iterator[Start]:
    assert pki.is_dir()
    started: list[subprocess.Popen[bytes]] = []

    def start(endpoint: str, uplinks: Sequence[str] = ()) -> subprocess.Popen[bytes]:
        file = tmp_path / f"{len(started)}.toml"
        file.write_text(MISSION.format(endpoint=endpoint, uplinks=list(uplinks)))
        load_mission(file)
        command = [sys.executable, "-P", "-m", "protocol.router", "--mission", str(file), "--run", str(tmp_path)]
        started.append(subprocess.Popen(command, stderr=subprocess.DEVNULL, env=environment(os.environ)))
        return started[-1]

    yield start
    for router in started:
        router.kill()
        router.wait()


def endpoints(count: int) -> list[str]:
    return [f"tls/127.0.0.1:{free_port()}" for _ in range(count)]


async def hears(speaker: Bus, listener: Bus, topic: Topic[Any], message: Message, drone: int | str = "") -> bool:
    """Whether what one says reaches the other before long."""
    heard: list[Message] = []
    listener.on(topic, heard.append, drone or "")
    for _ in range(round(PATIENCE_S / POLL_S)):
        speaker.put(topic, message, drone)
        if await listener.until(lambda: bool(heard), POLL_S):
            return True
    return False


async def drone_hears(ground: Bus, drone: Bus) -> bool:
    return await hears(ground, drone, topics.HEAD, JumpHead(epoch=1, next_sequence=0, done=0, phase="flying"))


async def ground_hears(drone: Bus, ground: Bus) -> bool:
    event = Event(source="drone/1", tick=1, level="info", kind="mode", text="here")
    return await hears(drone, ground, topics.EVENT, event, 1)


def link(pki: Path, identity: str, *endpoints: str) -> Link:
    credentials = load_credentials(pki, identity, now=datetime.now(UTC))
    return Link(endpoints[0], endpoints[1:], credentials)


async def test_when_one_of_two_routers_dies_its_clients_meet_at_the_other(start: Start, pki: Path) -> None:
    first, second = endpoints(2)
    doomed = start(first)
    start(second, [first])
    async with (
        connect(link(pki, "drone-1", first, second), "sites") as drone,
        connect(link(pki, "ground", second, first), "sites") as ground,
    ):
        ground.watch_lives()
        drone.announce("drone/1")
        assert await drone_hears(ground, drone), "they are at different routers"
        assert await ground.until(lambda: "drone/1" in ground.alive, PATIENCE_S)

        doomed.kill()
        doomed.wait()
        assert await ground.until(lambda: "drone/1" not in ground.alive, PATIENCE_S)

        assert await ground.until(lambda: "drone/1" in ground.alive, PATIENCE_S)
        assert await drone_hears(ground, drone)
        assert await ground_hears(drone, ground)


async def test_sites_hear_each_other_through_the_router_above_them(start: Start, pki: Path) -> None:
    above, *sites = endpoints(3)
    for site in sites:  # which wait for the one above, however late it comes
        start(site, [above])
    start(above)
    async with (
        connect(link(pki, "drone-1", sites[0]), "sites") as drone,
        connect(link(pki, "ground", sites[1]), "sites") as ground,
    ):
        assert await drone_hears(ground, drone)
        assert await ground_hears(drone, ground)


async def test_a_site_goes_on_alone_while_the_router_above_it_is_away(start: Start, pki: Path) -> None:
    above, site = endpoints(2)
    upper = start(above)
    start(site, [above])
    async with (
        connect(link(pki, "drone-1", site), "sites") as drone,
        connect(link(pki, "operator-anna", site), "sites") as mate,
        connect(link(pki, "ground", above), "sites") as ground,
    ):
        assert await drone_hears(ground, drone)
        upper.kill()
        upper.wait()
        assert await ground_hears(drone, mate)
        start(above)
        assert await drone_hears(ground, drone), "and finds back to it"
