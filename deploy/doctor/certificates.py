"""Whether the certificates that a mission names are there, good, and not about to end."""

from __future__ import annotations

import ipaddress
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

from deploy.doctor.finding import Finding
from deploy.pki.signing import hosts_of
from protocol.certificates import days_left, load_certificate
from protocol.credentials import ROUTER, Credentials, identities_in, load_credentials, load_register
from protocol.endpoints import CERTIFIED, internet_endpoint
from protocol.errors import CredentialsError
from protocol.transport_settings import Transport

SUBJECT = "certificates"
ANYWHERE = ("0.0.0.0", "::")  # noqa: S104  # said to a router, all addresses of its computer: no name to be called by


def check_certificates(transport: Transport, now: datetime) -> Iterator[Finding]:
    """One finding for each identity of this computer; of a router's also whom it would let in, and under which name."""
    endpoints = [place for place in (transport.endpoint, *transport.alternatives) if place.startswith(f"{CERTIFIED}/")]
    if not endpoints:
        yield Finding(SUBJECT, "ok", "none needed by this endpoint")
        return
    if not transport.credentials:
        advice = "make them (covrecon pki init), and set transport.credentials to their folder"
        yield Finding(SUBJECT, "fail", f"{endpoints[0]} needs certificates, and the mission names none", advice)
        return
    folder = Path(transport.credentials)
    identities = identities_in(folder)
    if not identities:
        advice = "copy this computer's from the authority's, where covrecon pki issue makes them"
        yield Finding(SUBJECT, "fail", f"{folder} has none", advice)
    for identity in identities:
        try:
            credentials = load_credentials(folder, identity, now=now)
        except CredentialsError as error:
            yield _failed(f"certificate {identity}", error)
            continue
        yield _judged(credentials, now)
        if identity == ROUTER:
            yield from _check_router(credentials, endpoints, now)


def _judged(credentials: Credentials, now: datetime) -> Finding:
    left = f"{credentials.common_name}, {days_left(credentials.expires, now)} days left"
    subject = f"certificate {credentials.identity}"
    if credentials.warning:
        return Finding(subject, "warn", left, f"covrecon pki renew {credentials.identity}")
    return Finding(subject, "ok", left)


def _check_router(credentials: Credentials, endpoints: list[str], now: datetime) -> Iterator[Finding]:
    try:
        admitted = load_register(credentials.folder).admitted(now)
        yield Finding("register", "ok", f"certificates that the router admits: {len(admitted)}")
    except CredentialsError as error:
        yield _failed("register", error)
    called = [place[1] for place in map(internet_endpoint, endpoints) if place is not None and place[1] not in ANYWHERE]
    names = {_same(name) for name in hosts_of(load_certificate(credentials.certificate, ""))}
    if called and not names & {_same(host) for host in called}:
        yield Finding(
            "router's names",
            "fail",
            f"{credentials.common_name} is not for {' or '.join(called)}: whoever calls the router so would refuse it",
            f"covrecon pki renew {ROUTER} --host {called[0]}",
        )


def _same(host: str) -> str:
    """One spelling of an address or a name."""
    try:
        return str(ipaddress.ip_address(host))
    except ValueError:
        return host.lower()


def _failed(subject: str, error: CredentialsError) -> Finding:
    """What is wrong and what to do, which these errors say one after the other."""
    text, _, advice = str(error).rpartition("; ")
    return Finding(subject, "fail", text or str(error), advice)
