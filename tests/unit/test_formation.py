from __future__ import annotations

import math
from itertools import pairwise

import pytest

from protocol.formation import SPACING, formation
from protocol.mission import Flight


def test_the_first_drone_starts_where_the_papers_does() -> None:
    start = formation(Flight(), 1)[0]

    assert start[:4] == (0.0, 1.0, 2.0, 0.0)
    assert start[4] == pytest.approx((math.pi / 3 + math.pi / 2) / 2)


@pytest.mark.parametrize("separation_m", [0.5, 1.0, 1.3])
def test_all_starts_lie_in_the_region_and_apart(separation_m: float) -> None:
    flight = Flight(separation_m=separation_m)

    starts = formation(flight, 255)

    assert len(starts) >= 9
    assert all(flight.contains(start) for start in starts)
    gaps = [math.dist(a[:3], b[:3]) for index, a in enumerate(starts) for b in starts[:index]]
    assert min(gaps) >= SPACING * separation_m * (1 - 1e-9)


def test_a_larger_team_keeps_the_starts_of_a_smaller_one() -> None:
    for smaller, larger in pairwise(formation(Flight(), count) for count in range(1, 20)):
        assert larger[: len(smaller)] == smaller


def test_taken_places_are_kept_clear() -> None:
    taken = [(0.2, 1.1, 2.4)]

    starts = formation(Flight(), 10, taken)

    assert len(starts) == 10
    assert min(math.dist(start[:3], taken[0]) for start in starts) >= SPACING * (1 - 1e-9)


def test_a_region_away_from_the_papers_start_is_used_from_its_nearest_corner() -> None:
    flight = Flight(lower_m=(100.0, 50.0, 10.0), upper_m=(104.0, 54.0, 12.0))

    start = formation(flight, 1)[0]

    assert start[:3] == (100.5, 50.5, 10.0)


def test_a_region_that_is_too_narrow_holds_nobody() -> None:
    assert formation(Flight(lower_m=(0.0, 0.0, 0.5), upper_m=(0.9, 8.0, 5.0)), 1) == []
