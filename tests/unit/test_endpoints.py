"""Which endpoints may be used, and by whom."""

from __future__ import annotations

import pytest

from protocol.endpoints import internet_endpoint, why_refused
from protocol.errors import BusError
from protocol.mission import Mission
from protocol.session import Link, require_safe
from protocol.transport_settings import Transport


@pytest.mark.parametrize(
    "endpoint",
    ["", "unixsock-stream//tmp/z.sock", "tcp/127.0.0.1:7447", "tcp/[::1]:7447", "udp/localhost:7447", "ws/127.8.0.1:1"],
)
def test_this_computer_alone_needs_no_certificate(endpoint: str) -> None:
    assert not why_refused(endpoint, certified=False)


@pytest.mark.parametrize("endpoint", ["tcp/0.0.0.0:7447", "tcp/10.0.0.1:7447", "udp/[::]:7447", "ws/ground.local:7447"])
@pytest.mark.parametrize("certified", [True, False])
def test_an_open_endpoint_without_encryption_is_refused_in_any_case(endpoint: str, certified: bool) -> None:
    reason = why_refused(endpoint, certified=certified)
    assert "would be open to other computers" in reason
    assert f"write tls/{endpoint.partition('/')[2]}" in reason


@pytest.mark.parametrize("endpoint", ["tls/10.0.0.1:7447", "tls/127.0.0.1:7447", "tls/ground.local:7447#x=1"])
def test_tls_needs_a_certificate(endpoint: str) -> None:
    assert not why_refused(endpoint, certified=True)
    assert "covrecon pki init" in why_refused(endpoint, certified=False)


@pytest.mark.parametrize("endpoint", ["quic/127.0.0.1:7447", "vsock/-1:1234"])
def test_other_protocols_are_refused(endpoint: str) -> None:
    assert "cannot be used" in why_refused(endpoint, certified=True)


def test_an_endpoint_is_taken_apart() -> None:
    assert internet_endpoint("tls/[fe80::1]:7447#tls_handshake_timeout_ms=5") == ("tls", "fe80::1", 7447)
    assert internet_endpoint("unixsock-stream/z.sock") is None


def test_every_endpoint_of_a_mission_is_judged() -> None:
    transport = Transport(
        endpoint="tls/10.0.0.1:7447", alternatives=("tcp/10.0.0.2:7447",), uplinks=("udp/10.1.0.1:7447",)
    )
    faults = transport.faults()
    assert [fault.split(": ")[0] for fault in faults] == [
        "transport.endpoint",
        "transport.alternatives.0",
        "transport.uplinks.0",
    ]
    with pytest.raises(ValueError, match=r"transport.endpoint: tls/10.0.0.1:7447 needs certificates"):
        Mission.model_validate({"drones": [{"id": 1, "start": [0, 0, 2, 0, 1.5]}], "transport": transport})


def test_a_process_that_is_given_an_open_endpoint_refuses_it_before_it_listens() -> None:
    with pytest.raises(BusError, match=r"tcp/0\.0\.0\.0:7447: would be open to other computers"):
        require_safe(Link("tcp/0.0.0.0:7447"))
    with pytest.raises(BusError, match=r"tcp/10\.0\.0\.2:7447: would be open"):
        require_safe(Link("tcp/127.0.0.1:7447", ("tcp/10.0.0.2:7447",)))
