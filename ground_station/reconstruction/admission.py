"""Which keyframes are of any use for a map: what every method that works from images refuses alike."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ground_station.reconstruction.depth_range import DepthRange, depth_range
from ground_station.reconstruction.reconstructor import Keyframe, Refusal
from ground_station.reconstruction.views import CONTRAST_MIN, SHARPNESS_MIN, View, contrast, sharpness
from protocol.mission import Mission


class Admission:
    def __init__(self, mission: Mission) -> None:
        self._settings = mission.reconstruction
        self._box = mission.target
        self._newest: dict[int, int] = {}  # tick
        self._newest_grey: dict[int, NDArray[np.uint8]] = {}

    @property
    def newest(self) -> Mapping[int, int]:
        """Tick of each drone's newest keyframe that was let in."""
        return self._newest

    def examine(self, keyframe: Keyframe, view: View) -> DepthRange | Refusal:
        """How near and far ``view``, the keyframe at the sweep's size, sees the box; or why it is of no use."""
        last = self._newest_grey.get(keyframe.drone)
        is_old = keyframe.tick <= self._newest.get(keyframe.drone, -1)
        if is_old or (last is not None and np.array_equal(view.grey, last)):
            return "repeated"
        if contrast(view.grey) < CONTRAST_MIN:
            return "featureless"
        if sharpness(view.grey) < SHARPNESS_MIN:
            return "blurred"
        span = depth_range(view, self._box, self._settings.truncation_m)
        if span is None or span.nearest > self._settings.farthest_m or span.farthest < self._settings.nearest_m:
            return "off_target"
        self._newest[keyframe.drone] = keyframe.tick
        self._newest_grey[keyframe.drone] = view.grey
        return span

    def state(self) -> NDArray[np.int64]:
        return np.array(sorted(self._newest.items()), np.int64).reshape(-1, 2)

    def restore(self, state: NDArray[np.int64]) -> None:
        """After the newest keyframes were examined again."""
        self._newest.update(state.tolist())
