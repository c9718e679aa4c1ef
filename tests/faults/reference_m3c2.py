"""M3C2 by py4dgeo, with which ours is compared."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np
import py4dgeo
from numpy.typing import NDArray

from protocol.geometry import Floats
from protocol.map_settings import Cylinder

logging.getLogger("py4dgeo").setLevel(logging.WARNING)  # what it logs goes to a file in the working directory as well


def reference_distances(
    cores: Floats,
    before: NDArray[np.float32],
    after: NDArray[np.float32],
    cylinder: Cylinder,
    *,
    normals: Floats | None = None,
    normal_radii: Sequence[float] = (),
) -> Floats:
    """(K,) m from ``before`` to ``after``, (P, 3) each, along the ``normals`` at ``cores``; NaN where either has no
    point in the cylinder. Without ``normals`` it fits planes to ``before`` within ``normal_radii``, m."""
    distances, _ = py4dgeo.M3C2(
        epochs=(py4dgeo.Epoch(before.astype(float)), py4dgeo.Epoch(after.astype(float))),
        corepoints=cores,
        corepoint_normals=normals,
        normal_radii=list(normal_radii),
        cyl_radius=cylinder.radius_m,
        max_distance=cylinder.half_length_m,
    ).run()
    return np.asarray(distances)
