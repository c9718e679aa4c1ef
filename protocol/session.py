"""How a zenoh session is opened: one router, everybody else its client, nothing found by scouting."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Literal

import zenoh

from protocol.errors import BusError
from protocol.wire import MAX_MESSAGE_BYTES

CONNECT_RETRY_S = 0.2
"""Between two tries of a client to reach its router, at first and whenever it lost it."""
CONNECT_TIMEOUT_S = 2.0
"""Of one try; zenoh's own default for a client is to fail at once."""
LEASE_MS = 2000
"""A process that vanishes without closing is noticed after 0.75 to 1 lease."""
BLOCK_MS = 500
"""How long a lossless put may wait for a slow link before the link is given up."""
TCP_BUFFER_BYTES = 65536
"""Of a socket, each way. What the kernel holds no priority can overtake: on a 10 Mbit/s uplink full of keyframes a
state took 618 ms (p99) through Linux's default buffers and 165 ms through these."""


def configuration(mode: Literal["router", "client"], endpoint: str, namespace: str) -> zenoh.Config:
    place = "listen" if mode == "router" else "connect"
    settings: dict[str, Any] = {
        "mode": mode,
        place: {"endpoints": [endpoint]},
        "namespace": namespace,
        "timestamping": {"enabled": False},
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            "shared_memory": {"enabled": False},
            "link": {
                "tcp": {"so_sndbuf": TCP_BUFFER_BYTES, "so_rcvbuf": TCP_BUFFER_BYTES},
                "tx": {
                    "lease": LEASE_MS,
                    "queue": {"congestion_control": {"block": {"wait_before_close": BLOCK_MS * 1000}}},
                },
                "rx": {"max_message_size": MAX_MESSAGE_BYTES},
            },
        },
    }
    if mode == "client":
        settings["connect"] |= {
            "timeout_ms": int(CONNECT_TIMEOUT_S * 1000),
            "retry": {
                "period_init_ms": int(CONNECT_RETRY_S * 1000),
                "period_max_ms": int(CONNECT_RETRY_S * 1000),
                "period_increase_factor": 1,
            },
        }
    return zenoh.Config.from_json5(json.dumps(settings))


@contextmanager
def errors_of(what: str) -> Iterator[None]:
    """zenoh's errors as `BusError`, without the place in its source that it appends."""
    try:
        yield
    except zenoh.ZError as error:
        raise BusError(f"{what}: {str(error).partition(' at /')[0]}") from error


async def open_session(endpoint: str, mission: str, *, router: bool, timeout_s: float) -> zenoh.Session:
    """A session in the namespace of ``mission``; a client waits up to ``timeout_s`` for the router.

    Raises:
        BusError: the endpoint is malformed, taken, or nobody listened in time.
    """
    loop = asyncio.get_running_loop()
    deadline = loop.time() + timeout_s
    what = f"cannot {'listen at' if router else 'reach'} {endpoint or 'an empty endpoint'}"
    with errors_of(what):
        config = configuration("router" if router else "client", endpoint, f"covrecon/{mission}")
    while True:
        try:
            with errors_of(what):
                return await asyncio.to_thread(zenoh.open, config)
        except BusError as error:
            if router:
                raise BusError(
                    f"{error}; set transport.endpoint to another, or ask who has it: covrecon doctor MISSION"
                ) from error
            if loop.time() > deadline:
                raise BusError(f"{error}; does the router run? Start it first, with the same endpoint") from error
            await asyncio.sleep(CONNECT_RETRY_S)
