"""Whether zones leave room to fly, and how much of it can be reached from a place: asked before take-off.

A grid, looked at once. It is fine enough that no zone, with its clearance twice as wide as it is kept, lies between two
of its points; a passage narrower than a step may be overlooked, and a start behind it refused.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from protocol.airspace import airspace_of
from protocol.geometry import Floats

if TYPE_CHECKING:
    from protocol.mission import Drone, Flight

POINTS_MAX = 1_500_000
"""Of the grid: a second of computing. A box of 100 m with a few zones has fewer."""
_ROUNDING_M = 1e-9
REACHED_LEAST = 0.5
"""Share of the free space that a start must reach: whoever cannot is shut in."""


@dataclass(frozen=True, slots=True, eq=False)
class FreeSpace:
    regions: NDArray[np.int32]
    """[x, y, level]: which connected part of the free space a place lies in; 0 where nobody may fly."""
    axes: tuple[Floats, Floats, Floats]
    volumes: Floats
    """m^3 of each part; 0 for what is not free."""

    @property
    def volume_m3(self) -> float:
        return float(self.volumes.sum())

    def reached(self, point: Sequence[float]) -> float:
        """Share of the free space that can be reached from ``point`` (x, y, z), where a drone may be."""
        near = [np.argsort(np.abs(axis - at))[:2] for axis, at in zip(self.axes, point, strict=False)]
        parts = self.regions[np.ix_(*near)]
        return float(self.volumes[parts].max() / self.volume_m3)


@lru_cache(maxsize=64)
def free_space(flight: Flight) -> FreeSpace:
    """Of a mission with zones."""
    airspace = airspace_of(flight)
    levels = airspace.levels()
    # Between two levels nothing begins or ends, so one place in the middle tells of all.
    heights = np.array(sorted({*levels, *((low + high) / 2 for low, high in pairwise(levels))}))
    spans = [high - low for low, high in zip(flight.lower_m[:2], flight.upper_m[:2], strict=True)]
    step = max(airspace.wide_m / 2, math.sqrt(spans[0] * spans[1] * len(heights) / POINTS_MAX))
    axes = [
        np.linspace(low, low + span, max(2, math.ceil(span / step) + 1))
        for low, span in zip(flight.lower_m, spans, strict=False)
    ]
    grid = np.stack(np.meshgrid(*axes, heights, indexing="ij"), axis=-1)
    free = airspace.margins(grid.reshape(-1, 3)).reshape(grid.shape[:3]) >= -_ROUNDING_M
    regions = np.empty(free.shape, np.int32)
    count = label(free, structure=np.ones((3, 3, 3)), output=regions)
    thickness = np.gradient(heights)
    cell = (axes[0][1] - axes[0][0]) * (axes[1][1] - axes[1][0])
    weights = np.broadcast_to(cell * thickness, free.shape)
    volumes = np.asarray(np.bincount(regions.ravel(), weights.ravel(), minlength=count + 1), np.float64)
    volumes[0] = 0.0
    return FreeSpace(regions, (axes[0], axes[1], heights), volumes)


def zone_faults(flight: Flight) -> list[str]:
    """What is wrong with the zones of a flight, each polygon being sound by itself."""
    faults = []
    low, high = flight.lower_m, flight.upper_m
    for x, y in flight.boundary or ():
        if not (low[0] <= x <= high[0] and low[1] <= y <= high[1]):
            faults.append(f"boundary: the corner {[x, y]} lies outside the box of lower_m and upper_m")
    names = [zone.name for zone in flight.no_fly]
    if len({*names}) < len(names):
        faults.append(f"no_fly: names must differ, got {names}")
    for zone in flight.no_fly:
        for axis, letter in enumerate("xy"):
            values = [corner[axis] for corner in zone.polygon]
            if max(values) <= low[axis] or min(values) >= high[axis]:
                faults.append(f"no_fly: {zone.name!r} lies outside the box along {letter}: it forbids nothing")
        if zone.upper_m is not None and zone.upper_m <= low[2]:
            faults.append(f"no_fly: {zone.name!r} lies below the box: it forbids nothing")
        if zone.lower_m is not None and zone.lower_m >= high[2]:
            faults.append(f"no_fly: {zone.name!r} lies above the box: it forbids nothing")
    if not faults and not airspace_of(flight).is_open and free_space(flight).volume_m3 == 0:
        keep = airspace_of(flight).wide_m
        faults.append(f"no_fly, boundary: nothing is left to fly in at {keep:.2f} m from zones and boundary")
    return faults


def start_fault(flight: Flight, start: Sequence[float]) -> str:
    """Why nobody may start at ``start`` (x, y, z, ...) for the zones; empty if one may."""
    airspace = airspace_of(flight)
    if airspace.is_open:
        return ""
    fault = airspace.fault(start)
    if fault:
        return fault
    share = free_space(flight).reached(start)
    if share < REACHED_LEAST:
        return f"is cut off: only {share:.0%} of where drones may fly can be reached from there"
    return ""


def start_faults(flight: Flight, drones: Sequence[Drone]) -> Iterator[str]:
    """One for each drone that may not start where it is to; opened by its key."""
    for index, drone in enumerate(drones):
        fault = start_fault(flight, drone.start)
        if fault and flight.contains(drone.start[:3]):
            yield f"drones.{index}.start: {list(drone.start[:3])} of drone {drone.id} {fault}"
