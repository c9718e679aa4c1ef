"""What of the field pulls a drone: its part of the QP's xi1, position by position.

xi1 of eq. (15) is delta_1 times the sum of (dh1/dp) phi over the drone's own cells. The compiled kernel
(`protocol.sensing`) gives the sum; here are the summands, which only people want to see.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol.field import VirtualField
from protocol.geometry import Floats, optical_axis
from protocol.mission import Sensing


@dataclass(frozen=True, slots=True, eq=False)
class Attraction:
    """Positions without a part are left out."""

    rows: NDArray[np.int64]
    """(n,) which positions of the field, ascending."""
    places: Floats
    """(n, 3) m, world."""
    gradients: Floats
    """(n, 5) sum of (dh1/dp) phi over the position's own cells, per metre and per radian."""


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """One drone's line of sight to some positions."""

    distance: Floats
    """(n,) m."""
    sight: Floats
    """(n, 3) unit vectors from the camera."""
    along: Floats
    """(n,) cosine between sight and optical axis."""
    exponent: Floats
    """(n,) of h1, without the part of the view direction."""


def attraction(field: VirtualField, phi: NDArray[np.float32], sensing: Sensing, poses: Floats, own: int) -> Attraction:
    """Of the drone in row ``own`` of poses (drones, 5), which are ordered by id; phi (positions, directions)."""
    places = field.positions()
    view = _view(places, poses[own], sensing)
    rows = np.flatnonzero(view.exponent <= sensing.exponent_cut)
    places = places[rows]
    view = _view(places, poses[own], sensing)
    exponents = _exponents(view, field, sensing)
    owned = exponents <= sensing.exponent_cut
    for other, pose in enumerate(poses):
        if other != own:
            theirs = _exponents(_view(places, pose, sensing), field, sensing)
            owned &= exponents < theirs if other < own else exponents <= theirs  # a tie goes to the lowest id
    weights = np.where(owned, np.exp(-exponents) * phi[rows], 0.0)
    gradients = _gradients(weights, view, poses[own], field, sensing)
    chosen = weights.any(axis=1)
    return Attraction(rows[chosen], places[chosen], gradients[chosen])


def _view(places: Floats, pose: Floats, sensing: Sensing) -> _View:
    offset = places - pose[:3]
    distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
    sight = offset / distance[:, None]
    along = sight @ optical_axis(pose[3], pose[4])
    exponent = (1 - along) ** 2 / (2 * sensing.sigma_axis**2) + (distance - sensing.distance_m) ** 2 / (
        2 * sensing.sigma_distance_m**2
    )
    return _View(distance, sight, along, exponent)


def _aside(view: _View, field: VirtualField) -> Floats:
    """1 - c2 of every cell, (n, directions)."""
    aside: Floats = 1 + view.sight @ field.directions.T
    return aside


def _exponents(view: _View, field: VirtualField, sensing: Sensing) -> Floats:
    """E of h1 = exp(-E), eq. (1), (n, directions)."""
    exponents: Floats = view.exponent[:, None] + _aside(view, field) ** 2 / (2 * sensing.sigma_view**2)
    return exponents


def _gradients(weights: Floats, view: _View, pose: Floats, field: VirtualField, sensing: Sensing) -> Floats:
    """(n, 5) sums over directions of (dh1/dp) phi by the chain rule of E; ``weights`` = h1 phi of own cells."""
    yaw, pitch = pose[3], pose[4]
    axis = optical_axis(yaw, pitch)
    by_yaw = np.array([-np.sin(yaw), np.cos(yaw), 0.0]) * np.cos(pitch)
    by_pitch = np.array([-np.cos(yaw) * np.sin(pitch), -np.sin(yaw) * np.sin(pitch), -np.cos(pitch)])
    aside = _aside(view, field)
    total, distance = weights.sum(axis=1), view.distance
    toward_axis = total * (1 - view.along) / sensing.sigma_axis**2
    to_distance = total * (distance - sensing.distance_m) / sensing.sigma_distance_m**2
    by_view = 1 / (sensing.sigma_view**2 * distance)
    radial = toward_axis * view.along / distance + by_view * (weights * aside * (1 - aside)).sum(axis=1) + to_distance
    gradients = np.empty((len(total), 5))
    gradients[:, :3] = radial[:, None] * view.sight - (toward_axis / distance)[:, None] * axis
    gradients[:, :3] += by_view[:, None] * ((weights * aside) @ field.directions)
    gradients[:, 3] = toward_axis * (view.sight @ by_yaw)
    gradients[:, 4] = toward_axis * (view.sight @ by_pitch)
    return gradients
