"""The depth of one view from its neighbours: sweep, aggregation and sub-plane refinement, in a thread's own memory."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import Final, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from ground_station.reconstruction.depth_range import DepthRange
from ground_station.reconstruction.plane_sweep import PlaneSweep
from ground_station.reconstruction.semi_global import Disparity, SemiGlobal
from ground_station.reconstruction.views import View
from protocol.errors import ReconstructionError
from protocol.map_settings import Reconstruction

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


class Estimator(Protocol):
    """May be called from several threads at once."""

    def estimate(self, view: View, sources: Sequence[View], span: DepthRange) -> DepthMap: ...


def make_estimator(width: int, height: int, settings: Reconstruction) -> Estimator:
    """On the device that the mission asks for; ``width`` and ``height`` are those of the views.

    Raises:
        ReconstructionError: there is no torch, or no graphics card that it can use.
    """
    if settings.device == "cpu":
        return DepthEstimator(width, height, settings)
    has_torch = find_spec("torch") is not None
    if not has_torch and settings.device == "cuda":
        raise ReconstructionError(
            'reconstruction.device "cuda" needs torch, built for the card: covrecon doctor tells what there is'
        )
    # By name: it imports torch, which only missions that ask for it need.
    torch_sweep = import_module("ground_station.reconstruction.torch_sweep") if has_torch else None
    if torch_sweep is None or (settings.device == "auto" and not torch_sweep.has_card()):
        return DepthEstimator(width, height, settings)
    return cast("Estimator", torch_sweep.TorchDepthEstimator(settings))


class DepthEstimator:
    """May be called from several threads at once; each gets working memory of its own."""

    def __init__(self, width: int, height: int, settings: Reconstruction) -> None:
        self._width = width
        self._height = height
        self._settings = settings
        self._thread = threading.local()

    def estimate(self, view: View, sources: Sequence[View], span: DepthRange) -> DepthMap:
        """Depth of ``view`` between ``span.nearest`` and ``span.farthest``, within the mission's limits."""
        inverse_depths = inverse_depths_of(span, self._settings)
        sweep, aggregation = self._tools()
        return depth_map_of(
            aggregation.aggregate(sweep.costs(view, sources, inverse_depths), view.grey), inverse_depths
        )

    def _tools(self) -> tuple[PlaneSweep, SemiGlobal]:
        if not hasattr(self._thread, "tools"):
            planes = self._settings.depth_planes
            self._thread.tools = (
                PlaneSweep(self._width, self._height, self._settings.sources, planes),
                SemiGlobal(self._width, self._height, planes),
            )
        tools: tuple[PlaneSweep, SemiGlobal] = self._thread.tools
        return tools


def inverse_depths_of(span: DepthRange, settings: Reconstruction) -> NDArray[np.float32]:
    """Those of the planes to be swept."""
    nearest = max(span.nearest, settings.nearest_m)
    farthest = max(min(span.farthest, settings.farthest_m), nearest * 1.01)
    return planes(nearest, farthest, settings.depth_planes)


def depth_map_of(disparity: Disparity, inverse_depths: NDArray[np.float32]) -> DepthMap:
    """The depths that are believed."""
    step = (inverse_depths[-1] - inverse_depths[0]) / (len(inverse_depths) - 1)
    depth = np.float32(1) / (inverse_depths[0] + step * disparity.plane)
    return DepthMap(np.where(disparity.score >= SCORE_MIN, depth, np.float32(0)), disparity.score)


def planes(nearest_m: float, farthest_m: float, count: int) -> NDArray[np.float32]:
    """(count,) inverse depths, 1/m, ascending and evenly spaced: from one plane beyond ``farthest_m`` to ``nearest_m``.

    Depths at the outermost planes are not believed, because the true ones may lie beyond. Without the plane beyond, a
    floor that is seen from straight above, the farthest that there is in the whole image, would never be mapped.
    """
    step = (1 / nearest_m - 1 / farthest_m) / (count - 2)
    first = max(1 / farthest_m - step, 1 / (BEYOND * farthest_m))
    return np.linspace(first, 1 / nearest_m, count, dtype=np.float32)
