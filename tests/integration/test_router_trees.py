"""More than one router: two of one site, of which either may die, and a tree of sites."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from deploy.local import environment
from faults.ports import free_port
from protocol import topics
from protocol.bus import Bus, connect
from protocol.messages import JumpHead
from protocol.mission_file import load_mission
from protocol.session import Link

pytestmark = pytest.mark.light

PATIENCE_S = 20.0
POLL_S = 0.05
MISSION = """
name = "sites"
[transport]
endpoint = "{endpoint}"
uplinks = {uplinks}
[[drones]]
id = 1
start = [0.0, 0.0, 2.0, 0.0, 1.5]
"""
Start = Callable[..., "subprocess.Popen[bytes]"]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
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
    return [f"tcp/127.0.0.1:{free_port()}" for _ in range(count)]


async def hears(speaker: Bus, listener: Bus) -> bool:
    """Whether what one says reaches the other before long."""
    heard: list[int] = []
    listener.on(topics.HEAD, lambda head: heard.append(head.done))
    for number in range(round(PATIENCE_S / POLL_S)):
        speaker.put(topics.HEAD, JumpHead(epoch=1, next_sequence=0, done=number, phase="flying"))
        if await listener.until(lambda: bool(heard), POLL_S):
            return True
    return False


async def test_when_one_of_two_routers_dies_its_clients_meet_at_the_other(start: Start) -> None:
    first, second = endpoints(2)
    doomed = start(first)
    start(second, [first])
    async with (
        connect(Link(first, (second,)), "sites") as drone,
        connect(Link(second, (first,)), "sites") as ground,
    ):
        ground.watch_lives()
        drone.announce("drone/1")
        assert await hears(ground, drone), "they are at different routers"
        assert await ground.until(lambda: "drone/1" in ground.alive, PATIENCE_S)

        doomed.kill()
        doomed.wait()
        assert await ground.until(lambda: "drone/1" not in ground.alive, PATIENCE_S)

        assert await ground.until(lambda: "drone/1" in ground.alive, PATIENCE_S)
        assert await hears(ground, drone)
        assert await hears(drone, ground)


async def test_sites_hear_each_other_through_the_router_above_them(start: Start) -> None:
    above, *sites = endpoints(3)
    for site in sites:  # which wait for the one above, however late it comes
        start(site, [above])
    start(above)
    here, there = (Link(site) for site in sites)
    async with connect(here, "sites") as drone, connect(there, "sites") as ground:
        assert await hears(ground, drone)
        assert await hears(drone, ground)


async def test_a_site_goes_on_alone_while_the_router_above_it_is_away(start: Start) -> None:
    above, site = endpoints(2)
    upper = start(above)
    start(site, [above])
    async with connect(site, "sites") as drone, connect(site, "sites") as mate, connect(above, "sites") as ground:
        assert await hears(ground, drone)
        upper.kill()
        upper.wait()
        assert await hears(mate, drone)
        start(above)
        assert await hears(ground, drone), "and finds back to it"
