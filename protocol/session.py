"""How a zenoh session is opened: routers, everybody else a client of one, nothing found by scouting."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import zenoh

from protocol.credentials import Credentials
from protocol.endpoints import CERTIFIED, internet_endpoint, why_refused
from protocol.errors import BusError
from protocol.wire import MAX_MESSAGE_BYTES

CONNECT_RETRY_S = 0.2
"""Between two tries of a client to reach its router, at first and whenever it lost it."""
CONNECT_TIMEOUT_S = 2.0
"""Of one try; zenoh's own default for a client is to fail at once."""
HANDSHAKE_S = 5.0
"""How long a stranger may take to show a certificate before its connection is closed."""
LEASE_MS = 2000
"""A process that vanishes without closing is noticed after 0.75 to 1 lease."""
BLOCK_MS = 500
"""How long a lossless put may wait for a slow link before the link is given up."""
TCP_BUFFER_BYTES = 65536
"""Of a socket, each way. What the kernel holds no priority can overtake: on a 10 Mbit/s uplink full of keyframes a
state took 618 ms (p99) through Linux's default buffers and 165 ms through these."""

Mode = Literal["router", "client"]


@dataclass(frozen=True, slots=True)
class Link:
    """How one process reaches the others of its mission."""

    endpoint: str
    """Where its router listens."""
    alternatives: tuple[str, ...] = ()
    """Of routers that a client tries when the first does not answer."""
    credentials: Credentials | None = None
    """What it shows there; without any it stays on this computer."""

    @property
    def endpoints(self) -> tuple[str, ...]:
        return (self.endpoint, *self.alternatives)


def namespace_of(mission: str) -> str:
    """Before all keys of a mission of this name."""
    return f"covrecon/{mission}"


def configuration(
    mode: Mode, link: Link, mission: str, *, uplinks: Sequence[str] = (), access: dict[str, Any] | None = None
) -> dict[str, Any]:
    """zenoh's configuration of one process of ``mission``, as its configuration files have it.

    Args:
        link: where a router listens, or a client connects.
        uplinks: endpoints of other routers that a router connects to, for as long as it takes.
        access: of a router, `protocol.access.access_control`.
    """
    tls = _certificates(mode, link.credentials)
    told: dict[str, Any] = {
        "mode": mode,
        "namespace": namespace_of(mission),
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
                **({"tls": tls} if tls else {}),
            },
        },
    }
    retry = {
        "period_init_ms": int(CONNECT_RETRY_S * 1000),
        "period_max_ms": int(CONNECT_RETRY_S * 1000),
        "period_increase_factor": 1,
    }
    if mode == "client":
        timeout_ms = int(CONNECT_TIMEOUT_S * 1000)
        told["connect"] = {"endpoints": list(link.endpoints), "timeout_ms": timeout_ms, "retry": retry}
    else:
        told["listen"] = {"endpoints": [_listening(link.endpoint)]}
        told["connect"] = {"endpoints": list(uplinks), "timeout_ms": -1, "exit_on_failure": False, "retry": retry}
    if access is not None:
        told["access_control"] = access
    return told


def _certificates(mode: Mode, credentials: Credentials | None) -> dict[str, Any]:
    """Both sides show certificates of one authority; a router connects to others as well."""
    if credentials is None:
        return {}
    told: dict[str, Any] = {
        "root_ca_certificate": str(credentials.authority),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
        "so_sndbuf": TCP_BUFFER_BYTES,
        "so_rcvbuf": TCP_BUFFER_BYTES,
    }
    for place in ("listen", "connect") if mode == "router" else ("connect",):
        told |= {
            f"{place}_certificate": str(credentials.certificate),
            f"{place}_private_key": str(credentials.key),
        }
    return told


def _listening(endpoint: str) -> str:
    """With the patience for a handshake, which zenoh takes from the endpoint alone."""
    if not endpoint.startswith(f"{CERTIFIED}/"):
        return endpoint
    return f"{endpoint}{';' if '#' in endpoint else '#'}tls_handshake_timeout_ms={int(HANDSHAKE_S * 1000)}"


@contextmanager
def errors_of(what: str) -> Iterator[None]:
    """zenoh's errors as `BusError`, without the place in its source that it appends."""
    try:
        yield
    except zenoh.ZError as error:
        raise BusError(f"{what}: {str(error).partition(' at /')[0]}") from error


def require_safe(link: Link, uplinks: Sequence[str] = ()) -> None:
    """Refuse to meet others where strangers could come as well.

    Raises:
        BusError: an endpoint that other computers reach has no mutual TLS.
    """
    for endpoint in (*link.endpoints, *uplinks):
        reason = why_refused(endpoint, certified=link.credentials is not None)
        if reason:
            raise BusError(f"{endpoint}: {reason}")


async def open_router(
    link: Link, mission: str, *, uplinks: Sequence[str] = (), access: dict[str, Any] | None = None
) -> zenoh.Session:
    """A session that listens at ``link.endpoint`` and routes.

    Raises:
        BusError: the endpoint is malformed, taken, or open to strangers.
    """
    require_safe(link, uplinks)
    what = f"cannot listen at {link.endpoint or 'an empty endpoint'}"
    try:
        with errors_of(what):
            config = _config(configuration("router", link, mission, uplinks=uplinks, access=access))
            return await asyncio.to_thread(zenoh.open, config)
    except BusError as error:
        raise BusError(
            f"{error}; set transport.endpoint to another, or ask who has it: covrecon doctor MISSION"
        ) from error


async def open_client(link: Link, mission: str, *, timeout_s: float) -> zenoh.Session:
    """A session in the namespace of ``mission``, which waits up to ``timeout_s`` for the router.

    Raises:
        BusError: the endpoint is malformed or open to strangers, or nobody let it in in time.
    """
    require_safe(link)
    loop = asyncio.get_running_loop()
    deadline = loop.time() + timeout_s
    what = f"cannot reach {' or '.join(filter(None, link.endpoints)) or 'an empty endpoint'}"
    with errors_of(what):
        config = _config(configuration("client", link, mission))
    while True:
        try:
            with errors_of(what):
                return await asyncio.to_thread(zenoh.open, config)
        except BusError as error:
            if loop.time() > deadline:
                raise BusError(f"{error}; {_what_to_try(link)}") from error
            await asyncio.sleep(CONNECT_RETRY_S)


def _config(told: dict[str, Any]) -> zenoh.Config:
    return zenoh.Config.from_json5(json.dumps(told))


def _what_to_try(link: Link) -> str:
    advice = "does the router run? Start it first, with the same endpoint"
    place = internet_endpoint(link.endpoint)
    if place is not None and place[0] == CERTIFIED:  # a client cannot tell a refusal from silence
        return f"{advice}. A router that refuses a certificate says so in its own log"
    return advice
