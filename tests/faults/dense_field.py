"""Eqs. (1) and (2) and the sums of a QP row over the list of all cells, in NumPy, as the paper prints them: what the
windowed kernel (`protocol.sensing`) is measured against."""

from __future__ import annotations

import numpy as np

from protocol.geometry import Floats, optical_axis
from protocol.mission import Sensing


def dense_tick(phi: Floats, cells: Floats, views: Floats, poses: Floats, sensing: Sensing, dt: float) -> Floats:
    """Decay ``phi`` by ``dt`` seconds with ``poses`` (drones, 5) held; the gradient (5,) of drone 0's QP row before it.

    phi (m,), changed in place; cells and views (m, 3): Pos(q_j) and Dir(q_j).
    """
    senses, geometry = [], []
    for pose in poses:
        to_cell = cells - pose[:3]
        r = np.linalg.norm(to_cell, axis=1)
        sight = to_cell / r[:, None]
        c1, c2 = sight @ optical_axis(pose[3], pose[4]), -(views * sight).sum(axis=1)
        senses.append(
            np.exp(-((1 - c1) ** 2) / (2 * sensing.sigma_axis**2))
            * np.exp(-((1 - c2) ** 2) / (2 * sensing.sigma_view**2))
            * np.exp(-((r - sensing.distance_m) ** 2) / (2 * sensing.sigma_distance_m**2))
        )
        geometry.append((r, sight, c1, c2))
    h = np.stack(senses)
    own = (h.argmax(axis=0) == 0) * h[0] * phi
    (r, sight, c1, c2), pose = geometry[0], poses[0]
    axis = optical_axis(pose[3], pose[4])
    along = own * (1 - c1) / sensing.sigma_axis**2
    view = own * (1 - c2) / sensing.sigma_view**2
    outward = own * (r - sensing.distance_m) / sensing.sigma_distance_m**2
    gradient = np.empty(5)
    gradient[:3] = (
        (along / r)[:, None] * (c1[:, None] * sight - axis)
        + (view / r)[:, None] * (views + c2[:, None] * sight)
        + outward[:, None] * sight
    ).sum(axis=0)
    cy, sy, cp, sp = np.cos(pose[3]), np.sin(pose[3]), np.cos(pose[4]), np.sin(pose[4])
    gradient[3] = along @ (sight @ np.array([-sy * cp, cy * cp, 0.0]))
    gradient[4] = along @ (sight @ np.array([-cy * sp, -sy * sp, -cp]))
    phi *= np.exp(-sensing.decay_per_s * dt * h.max(axis=0))
    return gradient
