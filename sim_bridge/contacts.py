"""Counts how often simulated vehicles touch the scene: a vehicle is a sphere, and the distance is exact.

Triangles lie in a lattice of cells over where vehicles may be, so that a tick looks at a few dozen of them. It is
judged at every tick, between which a vehicle moves some centimetres, and by the true pose.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numba import njit
from numpy.typing import NDArray

from protocol.geometry import Floats
from protocol.mission import Mission
from protocol.triangles import squared_distance

CELL_M = 0.25
BEYOND_M = 2.0
"""How far around the flight region the lattice reaches: farther off, nothing is touched any more."""

Counts = NDArray[np.int64]


class Contacts:
    def __init__(self, mission: Mission, triangles: NDArray[np.float32]) -> None:
        """``triangles`` (T, 3, 3) of the scene."""
        flight = mission.flight
        self._radius_m, self._triangles = mission.simulation.vehicle_radius_m, triangles
        self._origin = np.array(flight.lower_m) - BEYOND_M
        self._shape = np.ceil((np.array(flight.upper_m) + BEYOND_M - self._origin) / CELL_M).astype(np.int64)
        self._firsts, self._members = _sort(triangles, self._origin, self._shape)
        self._touching: set[int] = set()
        self.counts = dict.fromkeys((drone.id for drone in mission.drones), 0)
        """How often each vehicle began to touch something."""

    @property
    def told(self) -> tuple[tuple[int, int], ...]:
        """Drone and count, of those that touched something."""
        return tuple((drone, count) for drone, count in self.counts.items() if count)

    def rehearse(self, place: Floats) -> None:
        """Look once, so that nothing is left to be compiled in flight."""
        self._touches(place)

    def note(self, places: Mapping[int, Floats]) -> None:
        """Where the vehicles are that fly: (3,) or more, by drone. One that lands comes to stand on something."""
        for drone, place in places.items():
            if not self._touches(place):
                self._touching.discard(drone)
            elif drone not in self._touching:
                self._touching.add(drone)
                self.counts[drone] += 1

    def _touches(self, place: Floats) -> bool:
        return bool(
            _touches(place[:3], self._radius_m, self._triangles, self._firsts, self._members, self._origin, self._shape)
        )


@njit(cache=True, nogil=True)
def _span(low: float, high: float, origin: float, count: int) -> tuple[int, int]:
    """First and end of the cells that [low, high] touches along one axis."""
    first = int(np.floor((low - origin) / CELL_M))
    end = int(np.floor((high - origin) / CELL_M)) + 1
    return min(max(first, 0), count), min(max(end, 0), count)


@njit(cache=True, nogil=True)
def _sort(triangles: NDArray[np.float32], origin: Floats, shape: Counts) -> tuple[Counts, NDArray[np.int32]]:
    """Row by row of cells, x slowest: the triangles of cell c are ``members[firsts[c]:firsts[c + 1]]``."""
    firsts = np.zeros(shape[0] * shape[1] * shape[2] + 1, np.int64)
    members = np.empty(0, np.int32)
    filled = np.zeros(1, np.int64)
    for filling in (False, True):
        if filling:
            firsts = np.cumsum(firsts)
            members = np.empty(firsts[-1], np.int32)
            filled = firsts[:-1].copy()
        for face in range(len(triangles)):
            corners = triangles[face]
            x, x_end = _span(corners[:, 0].min(), corners[:, 0].max(), origin[0], shape[0])
            y, y_end = _span(corners[:, 1].min(), corners[:, 1].max(), origin[1], shape[1])
            z, z_end = _span(corners[:, 2].min(), corners[:, 2].max(), origin[2], shape[2])
            for i in range(x, x_end):
                for j in range(y, y_end):
                    for k in range(z, z_end):
                        cell = (i * shape[1] + j) * shape[2] + k
                        if filling:
                            members[filled[cell]] = face
                            filled[cell] += 1
                        else:
                            firsts[cell + 1] += 1
    return firsts, members


@njit(cache=True, nogil=True)
def _touches(
    place: Floats,
    radius: float,
    triangles: NDArray[np.float32],
    firsts: Counts,
    members: NDArray[np.int32],
    origin: Floats,
    shape: Counts,
) -> bool:
    x, x_end = _span(place[0] - radius, place[0] + radius, origin[0], shape[0])
    y, y_end = _span(place[1] - radius, place[1] + radius, origin[1], shape[1])
    z, z_end = _span(place[2] - radius, place[2] + radius, origin[2], shape[2])
    for i in range(x, x_end):
        for j in range(y, y_end):
            for k in range(z, z_end):
                cell = (i * shape[1] + j) * shape[2] + k
                for face in members[firsts[cell] : firsts[cell + 1]]:
                    if squared_distance(place, triangles[face]) < radius * radius:
                        return True
    return False
