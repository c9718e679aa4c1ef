"""Where a lawnmower flies: a camera's footprint, the strips that it takes to see a rectangle, and who sweeps which.

Source of the pattern: M. Torres, D. A. Pelta, J. L. Verdegay, J. C. Torres, "Coverage path planning with unmanned
aerial vehicles for 3D terrain reconstruction", Expert Systems with Applications 55 (2016).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from protocol.geometry import Floats
from protocol.map_settings import Camera


@dataclass(frozen=True, slots=True)
class Rectangle:
    low: tuple[float, float]
    """x, y in metres."""
    high: tuple[float, float]

    @property
    def longer_axis(self) -> int:
        """0 for x, also where both are as long."""
        return 0 if self.high[0] - self.low[0] >= self.high[1] - self.low[1] else 1


@dataclass(frozen=True, slots=True)
class Footprint:
    """What a camera that looks straight down sees of a plane below it."""

    width_m: float
    """Of the image's width, which lies across a strip."""
    length_m: float
    """Of its height, which lies along it."""


def footprint_of(camera: Camera, distance_m: float) -> Footprint:
    """On the plane ``distance_m`` below."""
    intrinsics = camera.intrinsics()
    return Footprint(
        distance_m * intrinsics.width / intrinsics.fx,
        distance_m * intrinsics.height / intrinsics.fy,
    )


def strip_centres(low: float, high: float, width: float, overlap: float) -> Floats:
    """(strips,) of the fewest equally spaced strips of ``width`` that cover [low, high], each seeing at least the share
    ``overlap`` of the next one; a single strip in the middle where one is enough."""
    rest = high - low - width
    if rest <= 0:
        return np.array([(low + high) / 2])
    spaces = math.ceil(rest / (width * (1 - overlap)) - 1e-9)  # not one more because of rounding
    return np.linspace(low + width / 2, high - width / 2, spaces + 1)


def sweep(sector: Rectangle, along: int, footprint: Footprint, overlap: float, start: Floats) -> Floats:
    """Waypoints (2 strips, 2) of a boustrophedon over ``sector`` with strips along axis ``along``, from the corner that
    is nearest to ``start`` (2,)."""
    across = 1 - along
    lines = strip_centres(sector.low[across], sector.high[across], footprint.width_m, overlap)
    middle = (sector.low[along] + sector.high[along]) / 2
    reach = max(0.0, (sector.high[along] - sector.low[along] - footprint.length_m) / 2)
    ends = [middle - reach, middle + reach]
    if abs(start[across] - lines[-1]) < abs(start[across] - lines[0]):
        lines = lines[::-1]
    if abs(start[along] - ends[1]) < abs(start[along] - ends[0]):
        ends.reverse()
    way = np.empty((2 * len(lines), 2))
    for k, line in enumerate(lines):
        way[2 * k : 2 * k + 2, across] = line
        way[2 * k : 2 * k + 2, along] = ends if k % 2 == 0 else ends[::-1]
    return way


def divide(area: Rectangle, starts: Mapping[int, tuple[float, float]]) -> dict[int, Rectangle]:
    """A part of ``area`` for each drone, all of the same size, by the drones' ``starts`` (x, y).

    The longer side is cut in proportion to two halves of the team, the drones that start lower take the lower part, and
    so on with the parts: nobody has to cross another one's way, and the parts are nearly square.
    """
    if len(starts) == 1:
        return dict.fromkeys(starts, area)
    axis = area.longer_axis
    order = sorted(starts, key=lambda drone: (starts[drone][axis], drone))
    half = len(order) // 2
    cut = area.low[axis] + (area.high[axis] - area.low[axis]) * half / len(order)
    lower = Rectangle(area.low, _with(area.high, axis, cut))
    upper = Rectangle(_with(area.low, axis, cut), area.high)
    return divide(lower, {drone: starts[drone] for drone in order[:half]}) | divide(
        upper, {drone: starts[drone] for drone in order[half:]}
    )


def _with(corner: tuple[float, float], axis: int, value: float) -> tuple[float, float]:
    return (value, corner[1]) if axis == 0 else (corner[0], value)
