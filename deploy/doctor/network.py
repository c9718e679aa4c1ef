"""Who could reach a mission's processes from elsewhere, and what would stop them."""

from __future__ import annotations

from collections.abc import Iterator

from deploy.doctor.finding import Finding
from protocol.endpoints import CERTIFIED, internet_endpoint, is_loopback, why_refused
from protocol.mission import Mission


def check_network(mission: Mission) -> Iterator[Finding]:
    transport = mission.transport
    yield _check_endpoint("transport", transport.endpoint, "transport.endpoint")
    for kind, endpoints in (("alternative", transport.alternatives), ("uplink", transport.uplinks)):
        for number, endpoint in enumerate(endpoints, start=1):
            yield _check_endpoint(f"{kind} {number}", endpoint, f"transport.{kind}s")
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


def _check_endpoint(subject: str, text: str, key: str) -> Finding:
    """Whether it may be used; of certificates it is only supposed that there are some."""
    if not text or text.startswith("unixsock-stream/"):
        return Finding(subject, "ok", text or "a unix socket, for this user alone")
    place = internet_endpoint(text)
    if place is None:
        return Finding(subject, "fail", f"{text} is no endpoint of zenoh", f"set {key} to {CERTIFIED}/<address>:7447")
    reason, _, advice = why_refused(text, certified=True).partition(": ")
    if reason:
        return Finding(subject, "fail", f"refused: {text} {reason}", f"{key}: {advice}")
    if is_loopback(place[1]):
        return Finding(subject, "ok", f"{text}, for this computer alone")
    return Finding(subject, "ok", f"{text}, for those with a certificate")
