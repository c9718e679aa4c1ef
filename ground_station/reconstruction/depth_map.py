"""The depth of one view from its neighbours: sweep, aggregation and sub-plane refinement, in a thread's own memory."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ground_station.reconstruction.depth_range import DepthRange
from ground_station.reconstruction.plane_sweep import PlaneSweep
from ground_station.reconstruction.semi_global import SemiGlobal
from ground_station.reconstruction.views import View
from protocol.mission import Reconstruction

BEYOND: Final = 4.0
"""The plane beyond the farthest depth is at most so many times as far: inverse depths stay positive with few planes."""
SCORE_MIN: Final = 0.35
"""Correlation under which a depth is not believed."""


@dataclass(frozen=True, slots=True, eq=False)
class DepthMap:
    depth: NDArray[np.float32]
    """(H, W) m along the optical axis, 0 where unknown."""
    score: NDArray[np.float32]
    """(H, W) correlation at that depth, in [0, 1]."""


class DepthEstimator:
    """May be called from several threads at once; each gets working memory of its own."""

    def __init__(self, width: int, height: int, settings: Reconstruction) -> None:
        self._width = width
        self._height = height
        self._settings = settings
        self._thread = threading.local()

    def estimate(self, view: View, sources: Sequence[View], span: DepthRange) -> DepthMap:
        """Depth of ``view`` between ``span.nearest`` and ``span.farthest``, within the mission's limits."""
        settings = self._settings
        nearest = max(span.nearest, settings.nearest_m)
        farthest = max(min(span.farthest, settings.farthest_m), nearest * 1.01)
        inverse_depths = planes(nearest, farthest, settings.depth_planes)
        sweep, aggregation = self._tools()
        disparity = aggregation.aggregate(sweep.costs(view, sources, inverse_depths), view.grey)
        step = (inverse_depths[-1] - inverse_depths[0]) / (settings.depth_planes - 1)
        depth = np.float32(1) / (inverse_depths[0] + step * disparity.plane)
        return DepthMap(np.where(disparity.score >= SCORE_MIN, depth, np.float32(0)), disparity.score)

    def _tools(self) -> tuple[PlaneSweep, SemiGlobal]:
        if not hasattr(self._thread, "tools"):
            planes = self._settings.depth_planes
            self._thread.tools = (
                PlaneSweep(self._width, self._height, self._settings.sources, planes),
                SemiGlobal(self._width, self._height, planes),
            )
        tools: tuple[PlaneSweep, SemiGlobal] = self._thread.tools
        return tools


def planes(nearest_m: float, farthest_m: float, count: int) -> NDArray[np.float32]:
    """(count,) inverse depths, 1/m, ascending and evenly spaced: from one plane beyond ``farthest_m`` to ``nearest_m``.

    Depths at the outermost planes are not believed, because the true ones may lie beyond. Without the plane beyond, a
    floor that is seen from straight above, the farthest that there is in the whole image, would never be mapped.
    """
    step = (1 / nearest_m - 1 / farthest_m) / (count - 2)
    first = max(1 / farthest_m - step, 1 / (BEYOND * farthest_m))
    return np.linspace(first, 1 / nearest_m, count, dtype=np.float32)
