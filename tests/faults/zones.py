"""Flight regions with zones for tests, from fixed and from random numbers."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from protocol.free_space import start_fault
from protocol.geometry import Floats
from protocol.mission import Flight

L_SHAPE = ((-4.0, -4.0), (4.0, -4.0), (4.0, 0.0), (0.0, 0.0), (0.0, 4.0), (-4.0, 4.0))
TABLE: dict[str, Any] = {
    "name": "table",
    "polygon": ((-2.4, -2.4), (-1.2, -2.4), (-1.2, -1.4), (-2.4, -1.4)),
    "upper_m": 1.2,
}
PILLAR: dict[str, Any] = {"name": "pillar", "polygon": ((0.6, -2.2), (1.4, -2.2), (1.0, -1.5))}


def l_shaped(**settings: Any) -> Flight:
    """An L of 8 m with a table that one may fly over, and a pillar from floor to ceiling."""
    return Flight(boundary=L_SHAPE, no_fly=(TABLE, PILLAR), **settings)  # type: ignore[arg-type]


def distance_m(flight: Flight, point: Floats) -> float:
    """How far ``point`` (3,) is from all zones and within the boundary, written down without the code that is tested:
    no hull, no pieces, and inside by crossings."""
    nearest = math.inf
    for zone in flight.no_fly:
        low = flight.lower_m[2] if zone.lower_m is None else max(zone.lower_m, flight.lower_m[2])
        high = flight.upper_m[2] if zone.upper_m is None else min(zone.upper_m, flight.upper_m[2])
        aside = 0.0 if is_inside(zone.polygon, point) else outline_m(zone.polygon, point)
        nearest = min(nearest, math.hypot(aside, max(low - point[2], point[2] - high, 0.0)))
    if flight.boundary is not None:
        aside = outline_m(flight.boundary, point)
        nearest = min(nearest, aside if is_inside(flight.boundary, point) else -aside)
    return nearest


def outline_m(polygon: tuple[tuple[float, float], ...], point: Floats) -> float:
    """Distance of the point from the nearest edge."""
    corners = np.array(polygon)
    along = np.roll(corners, -1, axis=0) - corners
    offset = point[:2] - corners
    shares = np.clip((offset * along).sum(axis=1) / (along**2).sum(axis=1), 0.0, 1.0)
    return float(np.linalg.norm(offset - shares[:, None] * along, axis=1).min())


def is_inside(polygon: tuple[tuple[float, float], ...], point: Floats) -> bool:
    """By the number of edges that a ray along +x crosses."""
    crossings = 0
    for (ax, ay), (bx, by) in zip(polygon, (*polygon[1:], polygon[0]), strict=True):
        if (ay > point[1]) != (by > point[1]):
            crossings += ax + (point[1] - ay) / (by - ay) * (bx - ax) > point[0]
    return crossings % 2 == 1


def star(rng: np.random.Generator, centre: tuple[float, float], radius: float) -> tuple[tuple[float, float], ...]:
    """A simple polygon of 3 to 8 corners around ``centre``, mostly not convex."""
    count = int(rng.integers(3, 9))
    angles = np.sort((np.arange(count) + rng.uniform(0.1, 0.9, count)) * 2 * math.pi / count)
    reach = radius * rng.uniform(0.35, 1.0, count)
    return tuple(
        (round(centre[0] + r * math.cos(a), 3), round(centre[1] + r * math.sin(a), 3))
        for r, a in zip(reach, angles, strict=True)
    )


def random_flight(seed: int, **settings: Any) -> tuple[Flight, np.random.Generator]:
    """A box of 8 m with up to four zones, of all heights or some, and in every other one a boundary."""
    rng = np.random.default_rng(seed)
    zones: list[dict[str, Any]] = []
    for k in range(int(rng.integers(1, 5))):
        x, y = rng.uniform(-3.0, 3.0, 2)
        zone: dict[str, Any] = {"name": f"zone {k}", "polygon": star(rng, (x, y), float(rng.uniform(0.4, 1.5)))}
        if rng.random() < 0.4:
            zone["upper_m"] = float(rng.uniform(1.0, 3.5))
        elif rng.random() < 0.4:
            zone["lower_m"] = float(rng.uniform(2.0, 4.0))
        zones.append(zone)
    boundary = star(rng, (0.0, 0.0), 4.0) if seed % 2 else None
    return Flight(boundary=boundary, no_fly=tuple(zones), **settings), rng  # type: ignore[arg-type]


def starts(flight: Flight, rng: np.random.Generator, count: int) -> list[tuple[float, float, float, float, float]]:
    """Up to ``count`` places apart at which drones may start."""
    chosen: list[tuple[float, float, float, float, float]] = []
    for _ in range(400):
        x, y, z = rng.uniform(flight.lower_m, flight.upper_m)
        apart = all(math.dist((x, y, z), other[:3]) > 1.2 * flight.separation_m for other in chosen)
        if apart and not start_fault(flight, (x, y, z)):
            chosen.append((float(x), float(y), float(z), 0.0, 1.3))
        if len(chosen) == count:
            break
    return chosen
