"""Where processes meet, and which places may be used without certificates: only those that nobody else can reach."""

from __future__ import annotations

import ipaddress
import re

CERTIFIED = "tls"
"""The one protocol of zenoh by which other computers are let in."""
PLAIN = ("tcp", "udp", "ws")
"""Protocols of zenoh without encryption: for this computer alone."""


def internet_endpoint(endpoint: str) -> tuple[str, str, int] | None:
    """Protocol, host and port of a zenoh endpoint like ``tcp/127.0.0.1:7447``; None of any other."""
    found = re.fullmatch(r"(\w+)/\[?([^\]]*?)\]?:(\d+)(?:[?#].*)?", endpoint)
    return (found[1], found[2], int(found[3])) if found else None


def is_loopback(host: str) -> bool:
    """Whether nobody but this computer reaches ``host``; a name counts only if it is the usual one."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def why_refused(endpoint: str, *, certified: bool) -> str:
    """Why an endpoint must not be used, with what to do; empty if it may be.

    Args:
        endpoint: as zenoh writes it.
        certified: whether this process has a certificate.
    """
    place = internet_endpoint(endpoint)
    if place is None:  # a unix socket, which the rights of its folder protect, or what zenoh will refuse
        return ""
    protocol, host, _ = place
    if protocol == CERTIFIED:
        return "" if certified else "needs certificates: make them (covrecon pki init) and set transport.credentials"
    if protocol not in PLAIN:
        return "cannot be used: take tls/, or tcp/127.0.0.1 on this computer alone"
    if is_loopback(host):
        return ""
    return (
        "would be open to other computers, without encryption and to whoever comes:"
        f" write {CERTIFIED}/{endpoint.partition('/')[2]} and set transport.credentials (covrecon pki init)"
    )
