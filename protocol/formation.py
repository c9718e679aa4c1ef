"""Start poses for drones that the mission file does not place itself."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TypeAlias

from protocol.mission import Flight

Point: TypeAlias = tuple[float, float, float]
Start: TypeAlias = tuple[float, float, float, float, float]

ANCHOR_M: Point = (0.0, 1.0, 2.0)
"""Where drone 1 starts (paper)."""
SPACING = 1.5
"""Distance between neighbours, in separations: half a separation to move before a barrier is felt."""
RINGS = 64
"""Lattice steps searched around the anchor: room for the 255 drones that ids allow, in any corner of a region."""


def formation(flight: Flight, count: int, taken: Sequence[Point] = ()) -> list[Start]:
    """Up to ``count`` poses [x, y, z, yaw, pitch], fewer if no more fit; the same for the same arguments.

    They lie on a level square lattice of ``SPACING`` separations through the paper's start of drone 1 (moved into the
    flight region where needed), nearest first, half a separation inside the region's sides, where its zones let a
    drone start, and ``SPACING`` separations from every point in ``taken`` (metres). Yaw is 0, pitch the middle of the
    gimbal's limits.
    """
    pitch = sum(flight.pitch_limits_rad) / 2
    occupied = list(taken)
    starts: list[Start] = []
    for point in _lattice(flight):
        if len(starts) == count:
            break
        if all(math.dist(point, other) >= SPACING * flight.separation_m * (1 - 1e-9) for other in occupied):
            if flight.has_zones and _may_not_start(flight, point):
                continue
            occupied.append(point)
            starts.append((*point, 0.0, pitch))
    return starts


def _may_not_start(flight: Flight, point: Point) -> bool:
    from protocol.free_space import start_fault  # as in `protocol.mission`, for missions with zones alone

    return bool(start_fault(flight, point))


def _lattice(flight: Flight) -> Iterator[Point]:
    margin = flight.separation_m / 2
    lower = [flight.lower_m[0] + margin, flight.lower_m[1] + margin, flight.lower_m[2]]
    upper = [flight.upper_m[0] - margin, flight.upper_m[1] - margin, flight.upper_m[2]]
    if any(low > high for low, high in zip(lower, upper, strict=True)):
        return
    x, y, z = (min(max(value, low), high) for value, low, high in zip(ANCHOR_M, lower, upper, strict=True))
    step = SPACING * flight.separation_m
    cells = [(i, j) for i in range(-RINGS, RINGS + 1) for j in range(-RINGS, RINGS + 1)]
    for i, j in sorted(cells, key=lambda cell: (cell[0] ** 2 + cell[1] ** 2, cell)):
        point = (x + i * step, y + j * step, z)
        if lower[0] <= point[0] <= upper[0] and lower[1] <= point[1] <= upper[1]:
            yield point
