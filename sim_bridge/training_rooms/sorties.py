"""Where a camera goes in a training room: drones' lanes at many heights and tilts, so that no one flight is learnt."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from protocol.geometry import Floats

HALF_M = 2.8
"""Lanes end so far from the room's middle; the target box ends at 3 m."""
LANE_M = (0.7, 1.1)
"""Range of the distance between neighbouring lanes; the study's lawnmower has 0.9 m."""
HEIGHT_M = (1.1, 2.9)
"""Range of a lane's height: drones fly from 1 to 3 m, for their best distance is 1 m to what is up to 2 m high."""
BOB_M = 0.25
"""Amplitude of the height along a lane."""
STEEP_RAD = (math.pi / 3, math.pi / 2)
"""Range of the depression angle, the flight's own limits ..."""
OBLIQUE_RAD = (math.pi / 6, math.radians(80))
"""... and that of missions which let cameras look ahead."""
OBLIQUE_SHARE = 0.3
"""Of sorties."""
STEP_M = (0.12, 0.26)
"""Range of the distance between photographs: from every keyframe to every other."""
CLEARANCE_M = 0.3
"""To the nearest surface; a photograph from within a wardrobe teaches nothing."""
CLIMB_M = 0.1
"""Step by which a place that is too near to something is raised ..."""
CEILING_M = 3.2
"""... and where that ends."""


def sortie(rng: np.random.Generator, count: int, clearance: Callable[[Floats], Floats]) -> Floats:
    """``count`` poses (N, 5) as in `protocol.geometry` along parallel lanes; ``clearance`` (n, 3) -> (n,) metres."""
    spacing, step = rng.uniform(*LANE_M), rng.uniform(*STEP_M)
    lanes = np.arange(-HALF_M + rng.uniform(0, spacing), HALF_M, spacing)
    if rng.random() < 0.5:
        lanes = lanes[::-1]
    along = np.arange(-HALF_M, HALF_M, step)
    path = np.concatenate(
        [
            np.column_stack([along[:: 1 if number % 2 else -1], np.full(len(along), lane)])
            for number, lane in enumerate(lanes)
        ]
    )
    if rng.random() < 0.5:
        path = path[:, ::-1]
    first = int(rng.integers(max(1, len(path) - count)))
    path = path[first : first + count]

    time = np.arange(len(path)) * step
    height = rng.uniform(*HEIGHT_M) + BOB_M * np.sin(time * rng.uniform(0.3, 1.2) + rng.uniform(0, 2 * math.pi))
    low, high = OBLIQUE_RAD if rng.random() < OBLIQUE_SHARE else STEEP_RAD
    swing = 0.5 + 0.5 * np.sin(time * rng.uniform(0.2, 0.9) + rng.uniform(0, 2 * math.pi))
    yaw = rng.uniform(-math.pi, math.pi) + rng.uniform(-0.6, 0.6) * time
    poses = np.column_stack([path, height, yaw, low + (high - low) * swing])
    while (near := (clearance(poses[:, :3]) < CLEARANCE_M) & (poses[:, 2] < CEILING_M)).any():
        poses[near, 2] += CLIMB_M
    return poses
