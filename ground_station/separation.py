"""How near the drones come to each other, for people and for the record; the drones keep apart by themselves."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence


def nearest_distances(poses: Mapping[int, Sequence[float]]) -> dict[int, float]:
    """Distance of each drone to its nearest neighbour, metres; infinite for a lone one. Poses begin with x, y, z."""
    nearest = dict.fromkeys(poses, math.inf)
    for one, other in itertools.combinations(poses, 2):
        distance = math.dist(poses[one][:3], poses[other][:3])
        nearest[one] = min(nearest[one], distance)
        nearest[other] = min(nearest[other], distance)
    return nearest
