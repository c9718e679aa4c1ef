"""Polygons are simple or refused, and cut into convex pieces that cover them exactly."""

from __future__ import annotations

import numpy as np
import pytest

from faults.zones import L_SHAPE, is_inside, star
from protocol.polygons import Ring, area, convex_hull, convex_pieces, pockets, polygon_fault

SQUARE = ((0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0))
COMB = (
    (0.0, 0.0),
    (5.0, 0.0),
    (5.0, 2.0),
    (4.0, 2.0),
    (4.0, 1.0),
    (3.0, 1.0),
    (3.0, 2.0),
    (1.0, 2.0),
    (1.0, 1.0),
    (0.5, 1.0),
)


@pytest.mark.parametrize(
    ("corners", "fault"),
    [
        (((0.0, 0.0), (1.0, 0.0)), "has 2 corners, a polygon needs 3"),
        (((0.0, 0.0), (1.0, 0.0), (2.0, 0.0)), "turns back on itself at [0.0, 0.0]"),
        (((0.0, 0.0), (2.0, 2.0), (2.0, 0.0), (0.0, 2.0)), "crosses itself"),
        ((*SQUARE, (0.0, 0.0)), "has the corner [0.0, 0.0] twice"),
        (((0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (1.0, 0.0), (0.0, 2.0)), "crosses itself"),
        (((0.0, 0.0), (2.0, 0.0), (3.0, 0.0), (2.5, 0.0), (2.5, 1.0)), "turns back on itself at [3.0, 0.0]"),
        (SQUARE, ""),
        (SQUARE[::-1], ""),
        (((0.0, 0.0), (1.0, 0.0), *SQUARE[1:]), ""),
        (L_SHAPE, ""),
        (COMB, ""),
    ],
)
def test_a_polygon_that_crosses_itself_or_encloses_nothing_is_refused(corners: Ring, fault: str) -> None:
    found = polygon_fault(corners)
    assert found.startswith(fault)
    assert bool(found) == bool(fault)


def test_a_convex_polygon_stays_whole() -> None:
    for corners in (SQUARE, SQUARE[::-1], ((0.0, 0.0), (3.0, 0.0), (1.0, 2.0))):
        (piece,) = convex_pieces(corners)
        assert set(piece.corners) == set(corners)
        assert area(piece.corners) > 0
        assert all(piece.outer)
        assert pockets(corners) == []


@pytest.mark.parametrize(
    "corners", [L_SHAPE, COMB, *(star(np.random.default_rng(k), (1.0, -2.0), 2.0) for k in range(40))]
)
def test_pieces_are_convex_and_cover_the_polygon_and_its_pockets_exactly(corners: Ring) -> None:
    rng = np.random.default_rng(0)
    pieces = convex_pieces(corners)
    holes = [piece for pocket in pockets(corners) for piece in convex_pieces(pocket, closed=False)]
    assert sum(area(piece.corners) for piece in pieces) == pytest.approx(abs(area(corners)))
    assert sum(area(piece.corners) for piece in [*pieces, *holes]) == pytest.approx(area(convex_hull(corners)))
    for piece in [*pieces, *holes]:
        assert area(piece.corners) == pytest.approx(area(convex_hull(piece.corners)))
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    for point in rng.uniform(low, high, (50, 2)):
        assert any(is_inside(piece.corners, point) for piece in pieces) == is_inside(corners, point)


@pytest.mark.parametrize("corners", [L_SHAPE, COMB, COMB[::-1]])
def test_outer_edges_are_those_of_the_polygon(corners: Ring) -> None:
    pieces = convex_pieces(corners)
    assert sum(sum(piece.outer) for piece in pieces) == len(corners)
    assert sum(len(piece.outer) - sum(piece.outer) for piece in pieces) == 2 * (len(pieces) - 1)
    for pocket in pockets(corners):
        cut = convex_pieces(pocket, closed=False)
        assert sum(sum(piece.outer) for piece in cut) == len(pocket) - 1, "all but the edge of the hull"


def test_a_polygon_that_touches_its_hull_between_two_pockets_has_both() -> None:
    corners = ((0.0, 0.0), (6.0, 0.0), (6.0, 2.0), (4.5, 1.0), (3.0, 2.0), (1.5, 1.0), (0.0, 2.0))
    assert sorted(area(pocket) for pocket in pockets(corners)) == pytest.approx([1.5, 1.5])
