"""Where a drone wants to go when it no longer covers: home, and down. Wishes only: the strict rows decide.

Two rules keep wishes from ending in a stalemate, which strict rows alone would hold for ever: who meets somebody on the
way keeps to the right, and nobody comes down above another.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from agents.barriers import Neighbour
from protocol.geometry import Floats

ARRIVED_M = 0.2
"""Horizontal distance from home at which it is reached."""
DESCENT_MPS = 0.3
ROOM = 1.5
"""Horizontal distance, in separations, within which somebody is in the way."""
APPROACH_PER_S = 0.8
"""Wished speed for each metre that is left."""


def home_wish(
    pose: Floats, home: Sequence[float], neighbours: Sequence[Neighbour], separation_m: float, speed_mps: float
) -> Floats:
    """Velocity (5,) towards ``home`` (x, y) at the present height; `down_wish` once it is reached."""
    offset = np.asarray(home[:2], float) - pose[:2]
    distance = float(np.linalg.norm(offset))
    if distance < ARRIVED_M:
        return down_wish(pose, neighbours, separation_m, speed_mps)
    heading = offset / distance
    if _meets(pose, heading, neighbours, separation_m):
        heading = (heading + np.array([heading[1], -heading[0]])) / math.sqrt(2)  # 45 degrees to the right
    wish = np.zeros(5)
    wish[:2] = heading * min(speed_mps, APPROACH_PER_S * distance)
    return wish


def down_wish(pose: Floats, neighbours: Sequence[Neighbour], separation_m: float, speed_mps: float) -> Floats:
    """Velocity (5,) straight down; sideways instead while somebody is below or near it."""
    away = np.zeros(2)
    for neighbour in neighbours:
        offset = pose[:2] - neighbour.position[:2]
        distance = float(np.linalg.norm(offset))
        if distance < separation_m and neighbour.position[2] < pose[2]:
            # Exactly above each other every direction is as good; the number makes two of them choose different ones.
            direction = offset / distance if distance > 1e-6 else _direction(neighbour.drone)
            away += direction * (1 - distance / separation_m + 0.2)
    wish = np.zeros(5)
    strength = float(np.linalg.norm(away))
    if strength > 0:
        wish[:2] = away / strength * min(speed_mps, strength)
    else:
        wish[2] = -min(DESCENT_MPS, speed_mps)
    return wish


def _meets(pose: Floats, heading: Floats, neighbours: Sequence[Neighbour], separation_m: float) -> bool:
    offsets = [neighbour.position - pose[:3] for neighbour in neighbours]
    return any(np.linalg.norm(offset) < ROOM * separation_m and heading @ offset[:2] > 0 for offset in offsets)


def _direction(number: int) -> Floats:
    return np.array([math.cos(number), math.sin(number)])
