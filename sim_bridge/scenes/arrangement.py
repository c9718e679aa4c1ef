"""Finds room for furniture: rectangles on the floor that keep clear of each other and of the room's edge."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from protocol.geometry import Floats
from sim_bridge.scenes.surfaces import Surfaces

CLEARANCE_M = 0.06
"""Left free around each piece: less would be a slit that no camera sees into."""


@dataclass(frozen=True, slots=True)
class Piece:
    """Furniture that stands on the floor, at its place."""

    name: str
    surfaces: Surfaces
    footprint: Floats
    """[4, 2] corners of the rectangle below it, counter-clockwise, metres."""

    def moved(self, x: float = 0.0, y: float = 0.0, yaw_deg: float = 0.0) -> Piece:
        """Turned about the z axis, then shifted."""
        c, s = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
        footprint = self.footprint @ np.array([[c, s], [-s, c]]) + (x, y)
        return Piece(self.name, self.surfaces.moved(x, y, yaw_deg=yaw_deg), footprint)


def piece(name: str, surfaces: Surfaces) -> Piece:
    """Furniture around the origin, its sides along the axes."""
    corners = surfaces.triangles[..., :2].reshape(-1, 2)
    (west, south), (east, north) = corners.min(axis=0), corners.max(axis=0)
    return Piece(name, surfaces, np.array([(west, south), (east, south), (east, north), (west, north)]))


def fits(group: Sequence[Piece], placed: Sequence[Piece], half_side_m: float) -> bool:
    """Whether ``group`` lies within +-``half_side_m`` and keeps clear of ``placed`` and of itself."""
    if any(np.abs(each.footprint).max() > half_side_m for each in group):
        return False
    for number, each in enumerate(group):
        others = [*placed, *group[:number]]
        if any(gap(each.footprint, other.footprint) < CLEARANCE_M for other in others):
            return False
    return True


def gap(one: Floats, other: Floats) -> float:
    """Largest distance between two rectangles [4, 2] along any of their sides, metres; negative where they overlap.

    By the separating axis theorem; no more than their true distance.
    """
    sides = np.concatenate([one[1:3] - one[:2], other[1:3] - other[:2]])
    axes = (sides / np.linalg.norm(sides, axis=1, keepdims=True)).T
    near, far = one @ axes, other @ axes
    apart = np.maximum(near.min(axis=0) - far.max(axis=0), far.min(axis=0) - near.max(axis=0))
    return float(apart.max())
