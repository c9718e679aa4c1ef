"""What a link between hosts does to packets, without any."""

from __future__ import annotations

import pytest

from faults.radio import WIRE, Shape, Way

SHAPE = Shape(rate_bps=8e6, delay_s=0.03, queue_s=0.004)
"""A packet of 1000 bytes passes in 1 ms."""


def packet(number: int) -> bytes:
    return bytes([number]) * 1000


def numbers(way: Way, now_s: float) -> list[int]:
    return [content[0] for _, content in way.arrived(now_s)]


def test_a_packet_takes_its_length_at_the_rate_and_then_the_delay() -> None:
    way = Way(SHAPE)

    way.send(packet(1), 10.0)

    assert way.due_s == pytest.approx(10.031)
    assert numbers(way, 10.0309) == []
    assert numbers(way, 10.0311) == [1]
    assert numbers(way, 99.0) == [], "handed out once"


def test_packets_of_one_moment_pass_one_after_another() -> None:
    way = Way(SHAPE)
    for number in range(3):
        way.send(packet(number), 10.0)

    arrivals = [due_s for due_s, _ in way.arrived(11.0)]

    assert arrivals == pytest.approx([10.031, 10.032, 10.033])


def test_a_full_queue_drops_who_comes_last_and_takes_in_again_when_it_has_room() -> None:
    way = Way(SHAPE)
    for number in range(9):
        way.send(packet(number), 10.0)
    way.send(packet(9), 10.002)

    assert numbers(way, 11.0) == [0, 1, 2, 3, 4, 9]
    assert (way.passed, way.dropped, way.lost) == (6, 4, 0)


def test_a_cut_link_loses_what_is_under_way_and_what_is_sent_until_it_heals() -> None:
    way = Way(SHAPE)
    way.send(packet(1), 10.0)
    way.cut = True
    way.send(packet(2), 10.01)
    assert numbers(way, 10.1) == []
    way.cut = False
    way.send(packet(3), 10.2)

    assert numbers(way, 11.0) == [3]
    assert (way.passed, way.dropped, way.lost) == (1, 0, 2)


def test_a_wire_changes_nothing() -> None:
    way = Way(WIRE)
    for number in range(100):
        way.send(packet(number), 10.0)

    assert numbers(way, 10.0) == list(range(100))
