"""zenoh's lines, and what people are told of them. The lines were copied from zenoh 1.10.2."""

from __future__ import annotations

import os

import pytest

from protocol.refusals import KINDS_MAX, Refusals, refusals_told

ZID = "7b1c1a5c996b74c2eed31ebf01c3cb12"
SUBJECT = f"{ZID} on Interface(lo)+CertCommonName(drone-1.1)+Transport(Tls)+{ZID}"
ACCESS = "2026-11-28T13:09:49.527224Z TRACE rx-1 ThreadId(11) zenoh::net::routing::interceptor::access_control:"
TLS = "2026-11-28T13:09:08.843901Z  WARN acc-0 ThreadId(05) zenoh_link_tls::unicast:"
HINT = "Hint: increase the system open file limit."


@pytest.fixture
def refusals() -> Refusals:
    return Refusals("covrecon/m")


def test_a_message_that_may_not_be_put_names_the_certificate_and_the_key(refusals: Refusals) -> None:
    line = f"{ACCESS} {SUBJECT} is unauthorized to Put (ingress) on covrecon/m/drone/2/state"
    assert refusals.take(line) == "refused: drone-1.1 may not put drone/2/state"


def test_a_decision_that_zenoh_remembers_is_told_with_the_name_it_was_made_for(refusals: Refusals) -> None:
    refusals.take(f"{ACCESS} {SUBJECT} is authorized to Put (ingress) on covrecon/m/drone/1/state")
    line = (
        f"{ACCESS} Using cached result: {ZID} is unauthorized to Declare Queryable (ingress) on covrecon/m/phi/blocks"
    )
    assert refusals.take(line) == "refused: drone-1.1 may not answer to phi/blocks"


def test_what_zenoh_decides_in_advance_is_no_refusal(refusals: Refusals) -> None:
    assert not refusals.take(f"{ACCESS} ACL (ingress): caching permissions for `covrecon/m/phi/blocks` ...")
    for action in ("Query", "Put", "Declare/Undeclare Queryable", "Declare Liveliness Subscriber"):
        line = f"{ACCESS} {SUBJECT} is unauthorized to {action} (ingress) on covrecon/m/phi/blocks"
        assert not refusals.take(line)
    real = f"{ACCESS} {SUBJECT} is unauthorized to Query (ingress) on covrecon/m/phi/blocks"
    assert refusals.take(real) == "refused: drone-1.1 may not ask phi/blocks"


@pytest.mark.parametrize(
    "line",
    [
        f"{ACCESS} {SUBJECT} is authorized to Put (ingress) on covrecon/m/drone/1/state",
        f"{ACCESS} {SUBJECT} is unauthorized to Put (egress) on covrecon/m/drone/1/setpoint",
        "no line of zenoh's at all",
        "",
    ],
)
def test_what_is_allowed_or_only_not_passed_on_is_no_refusal(refusals: Refusals, line: str) -> None:
    assert not refusals.take(line)


@pytest.mark.parametrize(
    "reason",
    [
        "peer sent no certificates",
        "invalid peer certificate: UnknownIssuer",
        "Timeout during TLS handshake",
        "received fatal alert: UnknownCA",
    ],
)
def test_a_connection_that_is_refused_is_told_with_the_reason(refusals: Refusals, reason: str) -> None:
    coloured = f"\x1b[2m{TLS[:27]}\x1b[0m{TLS[27:]} {reason}. {HINT}"
    assert refusals.take(coloured) == f"refused: a connection: {reason}"


def test_other_warnings_of_zenoh_are_passed_on(refusals: Refusals) -> None:
    line = "2026-11-28T13:09:08.8Z ERROR net-0 ThreadId(03) zenoh::net::runtime: it broke at /build/x.rs:3."
    assert refusals.take(line) == "zenoh: it broke"


def test_a_storm_is_told_ever_more_rarely_whatever_its_seconds(refusals: Refusals) -> None:
    told = [
        refusals.take(f"{TLS} invalid peer certificate: certificate expired: {1795871350 + second} (UNIX). {HINT}")
        for second in range(100)
    ]
    assert len([text for text in told if text]) == 7
    assert told[63].endswith("(time 64)")


def test_made_up_keys_do_not_fill_the_memory(refusals: Refusals) -> None:
    letters = str.maketrans("0123456789", "abcdefghij")
    for number in range(3 * KINDS_MAX):
        key = f"covrecon/m/{str(number).translate(letters)}"
        refusals.take(f"{ACCESS} {SUBJECT} is unauthorized to Put (ingress) on {key}")
    assert len(refusals.counts) <= KINDS_MAX + 1


def test_standard_output_is_read_and_given_back() -> None:
    told: list[str] = []
    with refusals_told("covrecon/m", told.append):
        os.write(1, f"{ACCESS} {SUBJECT} is unauthorized to Put (ingress) on covrecon/m/phi/jump\n".encode())
        os.write(1, b"\xff\xfe broken bytes\n" + f"{TLS} peer sent no certificates. {HINT}\n".encode())
    assert told == ["refused: drone-1.1 may not put phi/jump", "refused: a connection: peer sent no certificates"]
    os.write(1, b"")
