"""Plane polygons: whether one is simple, and what convex pieces it is made of.

Pure Python, because a mission has a few dozen corners, and they are looked at once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

Corner: TypeAlias = tuple[float, float]
Ring: TypeAlias = tuple[Corner, ...]
"""Corners in order; the last one is joined to the first."""

AREA_LEAST_M2 = 1e-6
"""A polygon with less is a line."""
_STRAIGHT = 1e-9
"""Twice the area, m^2, below which three corners lie on a line: above what float64 rounds 100 m from the origin."""


@dataclass(frozen=True, slots=True)
class Piece:
    """A convex part of a polygon."""

    corners: Ring
    """Counter-clockwise."""
    outer: tuple[bool, ...]
    """Whether the edge from corner k to the next one is an edge of the polygon, and not a cut through it."""


def polygon_fault(corners: Sequence[Corner]) -> str:
    """Why ``corners`` enclose no area without crossing themselves; empty if they do."""
    count = len(corners)
    if count < 3:
        return f"has {count} corner{'' if count == 1 else 's'}, a polygon needs 3"
    for k in range(count):
        for other in range(k):
            if math.dist(corners[k], corners[other]) < math.sqrt(AREA_LEAST_M2):
                return f"has the corner {list(corners[k])} twice"
    for k in range(count):
        before, here, after = corners[k - 1], corners[k], corners[(k + 1) % count]
        if abs(_turn(before, here, after)) <= _STRAIGHT and _ahead(here, before, after) > 0:
            return f"turns back on itself at {list(here)}"
    for k in range(count):
        for other in range(k):
            if (k - other) % count in (1, count - 1):
                continue
            if _touch(corners[other], corners[other + 1], corners[k], corners[(k + 1) % count]):
                edges = [[list(corners[i]), list(corners[(i + 1) % count])] for i in (other, k)]
                return f"crosses itself: its edges {edges[0]} and {edges[1]} meet"
    if abs(area(corners)) < AREA_LEAST_M2:
        return "encloses no area"
    return ""


def area(corners: Sequence[Corner]) -> float:
    """m^2; positive for counter-clockwise corners."""
    (x0, y0), count = corners[0], len(corners)
    steps = ((corners[k], corners[(k + 1) % count]) for k in range(count))
    return sum((ax - x0) * (by - y0) - (bx - x0) * (ay - y0) for (ax, ay), (bx, by) in steps) / 2


def convex_hull(corners: Sequence[Corner]) -> Ring:
    """Counter-clockwise, without corners on straight edges (Andrew's monotone chain)."""
    points = sorted(corners)

    def chain(ordered: Sequence[Corner]) -> list[Corner]:
        kept: list[Corner] = []
        for point in ordered:
            while len(kept) > 1 and _turn(kept[-2], kept[-1], point) <= _STRAIGHT:
                kept.pop()
            kept.append(point)
        return kept[:-1]

    return (*chain(points), *chain(points[::-1]))


def pockets(corners: Sequence[Corner]) -> list[Ring]:
    """What a simple polygon lacks of its convex hull: simple polygons, counter-clockwise; none if it is convex.

    The last edge of each is the hull's, all others are the polygon's.
    """
    ring = _counter_clockwise(corners)
    sides = convex_hull(ring)
    hull = {
        corner
        for corner in ring
        if any(abs(_turn(sides[k - 1], sides[k], corner)) <= _STRAIGHT for k in range(len(sides)))
    }
    first = next(k for k, corner in enumerate(ring) if corner in hull)
    found, chain = [], [ring[first]]
    for step in range(1, len(ring) + 1):
        corner = ring[(first + step) % len(ring)]
        chain.append(corner)
        if corner in hull:
            if len(chain) > 2 and abs(area(chain)) > AREA_LEAST_M2:
                found.append(tuple(chain[::-1]))
            chain = [corner]
    return found


def convex_pieces(corners: Sequence[Corner], *, closed: bool = True) -> list[Piece]:
    """A simple polygon as convex ones that cover it without overlap: ears cut off, then merged again where the cut was
    not needed (Hertel and Mehlhorn), so that a convex polygon stays whole.

    ``closed``: whether the edge from the last corner to the first is an edge of the polygon too.
    """
    ring = _counter_clockwise(corners)
    edges = {(ring[k], ring[(k + 1) % len(ring)]) for k in range(len(ring))}
    if not closed:
        edges -= {(corners[-1], corners[0]), (corners[0], corners[-1])}
    pieces = _merged(_triangles(ring))
    return [
        Piece(piece, tuple((piece[k], piece[(k + 1) % len(piece)]) in edges for k in range(len(piece))))
        for piece in pieces
    ]


def _triangles(ring: Ring) -> list[Ring]:
    """Ears, counter-clockwise."""
    left: list[Corner] = list(ring)
    found: list[Ring] = []
    while len(left) > 3:
        ears = [k for k in range(len(left)) if _is_ear(left, k)]
        if not ears:  # by rounding alone: every simple polygon has two (G. H. Meisters, 1975); more is safe, less not
            return [*found, convex_hull(left)]
        # The roundest first: slivers would be many rows of a quadratic program where one is enough.
        k = max(ears, key=lambda k: _roundness(left[k - 1], left[k], left[(k + 1) % len(left)]))
        found.append((left[k - 1], left[k], left[(k + 1) % len(left)]))
        del left[k]
    return [*found, tuple(left)]


def _is_ear(ring: Sequence[Corner], k: int) -> bool:
    a, b, c = ring[k - 1], ring[k], ring[(k + 1) % len(ring)]
    if _turn(a, b, c) <= _STRAIGHT:
        return False
    return not any(
        min(_turn(a, b, point), _turn(b, c, point), _turn(c, a, point)) >= -_STRAIGHT
        for point in ring
        if point not in (a, b, c)
    )


def _roundness(a: Corner, b: Corner, c: Corner) -> float:
    longest = max(math.dist(a, b), math.dist(b, c), math.dist(c, a))
    return _turn(a, b, c) / longest**2


def _merged(pieces: list[Ring]) -> list[Ring]:
    while True:
        pair = next(
            (
                (one, other, whole)
                for one in range(len(pieces))
                for other in range(one)
                if (whole := _joined(pieces[one], pieces[other])) is not None
            ),
            None,
        )
        if pair is None:
            return pieces
        one, other, whole = pair
        pieces = [*[piece for k, piece in enumerate(pieces) if k not in (one, other)], whole]


def _joined(one: Ring, other: Ring) -> Ring | None:
    """The two as one polygon, if they share an edge and it is convex."""
    for i in range(len(one)):
        a, b = one[i], one[(i + 1) % len(one)]
        for j in range(len(other)):
            if (other[j], other[(j + 1) % len(other)]) == (b, a):
                whole = (*_from(one, i + 1), *_from(other, j + 1)[1:-1])
                return whole if _is_convex(whole) else None
    return None


def _from(ring: Ring, k: int) -> Ring:
    k %= len(ring)
    return ring[k:] + ring[:k]


def _is_convex(ring: Ring) -> bool:
    return all(_turn(ring[k - 2], ring[k - 1], ring[k]) >= -_STRAIGHT for k in range(len(ring)))


def _counter_clockwise(corners: Sequence[Corner]) -> Ring:
    return tuple(corners) if area(corners) > 0 else tuple(corners[::-1])


def _turn(a: Corner, b: Corner, c: Corner) -> float:
    """Twice the area of the triangle; positive if the way from a over b to c turns left."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _ahead(here: Corner, before: Corner, after: Corner) -> float:
    """Positive if the way from ``here`` to ``after`` leads back towards ``before``."""
    return (before[0] - here[0]) * (after[0] - here[0]) + (before[1] - here[1]) * (after[1] - here[1])


def _touch(a: Corner, b: Corner, c: Corner, d: Corner) -> bool:
    """Whether the segments ab and cd have a point in common."""
    sides = _turn(c, d, a), _turn(c, d, b), _turn(a, b, c), _turn(a, b, d)
    if sides[0] * sides[1] < 0 and sides[2] * sides[3] < 0:
        return True
    on = ((sides[0], c, d, a), (sides[1], c, d, b), (sides[2], a, b, c), (sides[3], a, b, d))
    return any(abs(side) <= _STRAIGHT and _ahead(point, start, end) <= 0 for side, start, end, point in on)
