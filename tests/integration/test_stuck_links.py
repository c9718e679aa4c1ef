"""A fleet's link that swallows what is written to it: whoever is behind it is given up all the same."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

from faults.certificates import make_credentials
from faults.ports import free_port
from faults.proxy import Fault, link
from protocol import topics
from protocol.bus import connect
from protocol.credentials import load_credentials
from protocol.messages import Keyframe
from protocol.session import Link

PATIENCE_S = 20.0
NOTICED_S = 6.0
"""A lease for zenoh to notice, as much for TCP, and a busy machine."""
BYTES, PERIOD_S = 20_000, 0.05
"""Of images, so that what the kernel keeps of a link is full before its lease is over."""
UNIT = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def image(number: int) -> Keyframe:
    return Keyframe(
        drone=2,
        sequence=number,
        tick=number,
        position=(0.0, 0.0, 0.0),
        rotation=UNIT,
        width=100,
        height=100,
        fx=1.0,
        fy=1.0,
        cx=1.0,
        cy=1.0,
        jpeg=bytes(BYTES),
    )


async def until(condition: Callable[[], bool], limit_s: float) -> float:
    """How long it took."""
    clock = asyncio.get_running_loop().time
    began = clock()
    while not condition():
        assert clock() - began < limit_s
        await asyncio.sleep(0.02)
    return clock() - began


async def test_who_is_behind_a_link_that_swallows_everything_is_gone_within_seconds(tmp_path: Path) -> None:
    make_credentials(tmp_path / "pki", (2,), ("anna", "bob"))
    port = free_port(socket.SOCK_STREAM)

    def by(identity: str, place: int) -> Link:
        return Link(f"tls/127.0.0.1:{place}", (), load_credentials(tmp_path / "pki", identity, now=datetime.now(UTC)))

    async with (
        connect(by("router", port), "m", router=True) as router,
        link(port) as swallowing,
        connect(by("operator-anna", int(swallowing.endpoint.rpartition(":")[2])), "m", timeout_s=PATIENCE_S) as anna,
        connect(by("operator-bob", port), "m", timeout_s=PATIENCE_S) as bob,
    ):
        seen: list[Keyframe] = []
        anna.on(topics.KEYFRAME, seen.append)
        anna.announce("anna")
        bob.watch_lives()
        await until(lambda: "anna" in bob.alive, PATIENCE_S)

        async def send() -> None:
            for number in range(10_000):
                router.put(topics.KEYFRAME, image(number), 2)
                await asyncio.sleep(PERIOD_S)

        sending = asyncio.create_task(send())
        await until(lambda: len(seen) > 2, PATIENCE_S)
        swallowing.set(Fault(held=("up", "down")))
        await until(lambda: "anna" not in bob.alive, NOTICED_S)
        swallowing.heal()
        await until(lambda: "anna" in bob.alive, PATIENCE_S)
        sending.cancel()
