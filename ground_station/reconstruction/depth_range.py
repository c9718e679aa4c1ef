"""How near and how far a view can see the box to be mapped: all other depths need no search."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from ground_station.reconstruction.views import View
from protocol.mission import Box

GRID: Final = (9, 6)
"""Rays cast across and down the image, corners included."""


@dataclass(frozen=True, slots=True)
class DepthRange:
    nearest: float
    """m along the optical axis."""
    farthest: float
    """m along the optical axis."""
    typical: float
    """m: median over the image of the depth at which a ray leaves the box."""


def depth_range(view: View, box: Box, margin_m: float) -> DepthRange | None:
    """Where rays of ``view`` cross ``box`` grown by ``margin_m``; None if none does."""
    camera = view.intrinsics
    across, down = np.meshgrid(np.linspace(0, camera.width, GRID[0]), np.linspace(0, camera.height, GRID[1]))
    pixels = np.column_stack([across.ravel() - 0.5, down.ravel() - 0.5, np.ones(across.size)])
    rays = pixels @ np.linalg.inv(view.calibration).T @ view.rotation.T  # one metre of depth each
    rays = np.where(np.abs(rays) < 1e-9, 1e-9, rays)
    to_lower = (np.array(box.lower_m) - margin_m - view.position) / rays
    to_upper = (np.array(box.upper_m) + margin_m - view.position) / rays
    entry = np.maximum(np.minimum(to_lower, to_upper).max(axis=1), 0.0)
    leave = np.maximum(to_lower, to_upper).min(axis=1)
    hit = leave > entry
    if not hit.any():
        return None
    return DepthRange(float(entry[hit].min()), float(leave[hit].max()), float(np.median(leave[hit])))
