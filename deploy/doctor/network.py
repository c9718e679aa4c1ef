"""Who could reach a mission's processes from elsewhere, and what would stop them."""

from __future__ import annotations

import ipaddress
from collections.abc import Iterator

from deploy.doctor.finding import Finding
from deploy.doctor.ports import internet_endpoint
from protocol.mission import Mission

CERTIFIED = ("tls", "quic")
"""Protocols of zenoh that want certificates."""
PLAIN = ("tcp", "udp", "ws")
"""Those that do not."""


def is_loopback(host: str) -> bool:
    """Whether nobody but this computer reaches ``host``; a name counts only if it is the usual one."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def check_network(mission: Mission) -> Iterator[Finding]:
    endpoint = internet_endpoint(mission.transport.endpoint)
    yield _check_transport(mission.transport.endpoint, endpoint)
    host = mission.console.host
    if is_loopback(host):
        yield Finding("console", "ok", "for this computer alone, with a token")
    else:
        yield Finding(
            "console",
            "warn",
            f"listens at {host}: its token travels unencrypted",
            "set console.host to 127.0.0.1 and come by ssh -L, or put a proxy with TLS before it",
        )
    yield _check_certificates(endpoint)


def _check_transport(text: str, endpoint: tuple[str, str, int] | None) -> Finding:
    if not text or text.startswith("unixsock-stream/"):
        return Finding("transport", "ok", text or "a unix socket, for this user alone")
    if endpoint is None or endpoint[0] not in (*PLAIN, *CERTIFIED):
        advice = "leave transport.endpoint empty, or set it to tcp/127.0.0.1:7447"
        return Finding("transport", "fail", f"{text} is no endpoint of zenoh", advice)
    if is_loopback(endpoint[1]):
        return Finding("transport", "ok", f"{text}, for this computer alone")
    return Finding(
        "transport",
        "warn",
        f"{text}: whoever reaches it can command the drones; there is no authentication",
        "set transport.endpoint to tcp/127.0.0.1:7447 and join computers by WireGuard or ssh -L",
    )


def _check_certificates(endpoint: tuple[str, str, int] | None) -> Finding:
    if endpoint is not None and endpoint[0] in CERTIFIED:
        return Finding(
            "certificates",
            "fail",
            f"{endpoint[0]} needs certificates, and a mission cannot name any",
            "set transport.endpoint to tcp/..., inside WireGuard or ssh -L",
        )
    return Finding("certificates", "ok", "none configured, and none needed by this endpoint")
