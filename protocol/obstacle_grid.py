"""Which cells of the flight region are free of obstacles: their lattice, what the crew vouches for, how they travel.

A cell is free or it is not; whether what is not free was seen or is only unknown makes no difference to a drone. Free
is what was seen free, and what the mission vouches for:

* all above ``flight.obstacles.clear_above_m``; the lattice ends there;
* the room around each drone's start, and straight up from there: the crew chose it, and a return ends in it. A map that
  sees something there is believed, for it is nearer than the crew thought;
* below it too for vehicles that took off from the ground, whatever a map sees: they stood there.

The lattice reaches to the sides of the flight box, and below it as far as a drone must look. Beyond, nothing is judged.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from protocol.errors import MessageError
from protocol.geometry import Floats
from protocol.separation import position_error, top_speed, widened

if TYPE_CHECKING:
    from protocol.messages import FreeCells
    from protocol.mission import Flight, Mission

Cells = NDArray[np.bool_]

CELLS_MAX = 1_000_000
"""A room of 20 x 20 x 2.5 m at 10 cm; 125 kB on the wire before it is packed. A way up through more would take a drone
longer to find than its setpoints last."""
START_SPARE = 1.5
"""Cells around a start beyond what the rows keep: half the diagonal of a cell is 0.87 of its edge."""
_ROUNDING = 1e-6


def kept_distance(flight: Flight, deviation_m: float = 0.0) -> float:
    """D: what a drone's predicted position keeps from cells that are not free, metres, so that its true one keeps
    ``clearance_m``; ``deviation_m``: standard deviation of its position."""
    distance = flight.clearance_m + position_error(flight, deviation_m)
    return widened(distance, top_speed(flight) * flight.response_time_s)


def clear_height(mission: Mission) -> float:
    """Where the crew vouches that nothing stands, metres."""
    wished = mission.flight.obstacles.clear_above_m
    return mission.target.upper_m[2] if wished is None else wished


def period_ticks(mission: Mission) -> int:
    """Between two maps of free cells, which take effect at multiples of it."""
    return max(1, round(mission.flight.obstacles.period_s / mission.tick_s))


@dataclass(frozen=True, slots=True, eq=False)
class ObstacleGrid:
    origin: Floats
    """(3,) lowest corner of cell (0, 0, 0); edges lie on the target box's lowest corner."""
    cell_m: float
    shape: tuple[int, int, int]
    vouched: Cells
    """[x, y, z] what the mission vouches for ..."""
    stood_on: Cells
    """... and what of it no map is believed against."""

    @classmethod
    def of(cls, mission: Mission) -> ObstacleGrid:
        flight, cell = mission.flight, mission.flight.obstacles.cell_m
        low = np.array(flight.lower_m)
        low[2] -= kept_distance(flight)
        high = np.array([*flight.upper_m[:2], clear_height(mission)])
        anchor = np.array(mission.target.lower_m)
        origin = anchor + cell * np.floor((low - anchor) / cell + _ROUNDING)
        x, y, z = np.maximum(np.ceil((high - origin) / cell - _ROUNDING), 1).astype(int).tolist()
        empty = cls(origin, cell, (x, y, z), np.zeros((x, y, z), np.bool_), np.zeros((x, y, z), np.bool_))
        empty._vouch(mission)
        return empty

    def _vouch(self, mission: Mission) -> None:
        radius = kept_distance(mission.flight) + START_SPARE * self.cell_m
        columns, heights = self._centres()
        for drone in mission.drones:
            aside = np.hypot(*(columns - np.array(drone.start[:2])).T).reshape(*self.shape[:2], 1)
            below = np.maximum(drone.start[2] - heights, 0.0)
            around = np.hypot(aside, below) <= radius
            self.vouched[around] = True
            if mission.vehicles.kind != "simulated":
                self.stood_on[(aside <= radius) & ~around] = True
        self.vouched[self.stood_on] = True

    def _centres(self) -> tuple[Floats, Floats]:
        """Of columns (x * y, 2), and heights (z,)."""
        xs, ys, zs = (
            low + self.cell_m * (np.arange(count) + 0.5) for low, count in zip(self.origin, self.shape, strict=True)
        )
        return np.stack(np.meshgrid(xs, ys, indexing="ij"), axis=-1).reshape(-1, 2), zs

    def pack(self, free: Cells) -> bytes:
        return zlib.compress(np.packbits(free).tobytes(), 6)

    def read(self, message: FreeCells) -> Cells:
        """[x, y, z] free cells. Raises `MessageError` for what is not this lattice's."""
        free = self.unpack(message.packed)
        return free if message.with_vouched else free | self.vouched

    def unpack(self, packed: bytes) -> Cells:
        """Raises `MessageError` for what is not this lattice's."""
        size = math.prod(self.shape)
        length = -(-size // 8)
        try:
            plain = zlib.decompressobj().decompress(packed, length + 1)
        except zlib.error as error:
            raise MessageError(f"free cells: {error}") from error
        if len(plain) != length:
            raise MessageError(f"free cells: not the {length} bytes of {self.shape} cells")
        bits = np.unpackbits(np.frombuffer(plain, np.uint8), count=size)
        return bits.view(np.bool_).reshape(self.shape)


def obstacle_faults(mission: Mission) -> list[str]:
    """What is wrong with ``flight.obstacles`` of an otherwise sound mission."""
    flight, settings = mission.flight, mission.flight.obstacles
    faults = []
    kept, clear = kept_distance(flight), clear_height(mission)
    if clear + kept > flight.upper_m[2]:
        faults.append(
            f"flight.obstacles.clear_above_m: {clear:g}, and {kept:.2f} m that drones keep from what is below it, leave"
            f" nothing to fly in under flight.upper_m {flight.upper_m[2]:g}"
        )
    if clear <= flight.lower_m[2] - kept:
        faults.append(f"flight.obstacles.clear_above_m: {clear:g} lies below where anybody flies: it has no effect")
    spans = (*(high - low for low, high in zip(flight.lower_m[:2], flight.upper_m[:2], strict=True)), max(clear, 0.1))
    cells = math.prod(span / settings.cell_m + 1 for span in spans)
    if cells > CELLS_MAX:
        faults.append(
            f"flight.obstacles.cell_m: {settings.cell_m:g} makes {cells / 1e6:.1f} million cells, more than"
            f" {CELLS_MAX / 1e6:.0f}"
        )
    tick = mission.tick_s
    if settings.period_s < tick:
        faults.append(f"flight.obstacles.period_s: must be at least a tick, {tick:g}")
    if mission.controller.separation_gain_per_s * flight.setpoint_timeout_s > 1:
        faults.append(
            "flight.obstacles: controller.separation_gain_per_s x flight.setpoint_timeout_s must be at most 1: a drone"
            " whose setpoints stop could reach an obstacle before it is braked"
        )
    return faults
