"""Keyframes that wait for a map that is slower than the drones photograph, and which of them it can best do without.

That is the one whose camera was nearest to two others that wait or are in the map, and looked the same way: it shows
the least that is new, and on a path leaves the smallest gap. Distances are in units of the rule by which cameras choose
keyframes: by one baseline, or one angle, apart is 1.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from protocol.geometry import Floats
from protocol.map_settings import Camera
from protocol.messages import Keyframe

WAITING_MAX: Final = 200
"""Keyframes that may wait: some ten seconds of four drones."""
HELD_MAX: Final = 2000
"""With those that are passed over, which are held until it is their turn to be logged: some 40 MB."""
COMPARED: Final = 512
"""Newest keyframes of the map that those waiting are compared with, as many as it keeps itself."""


@dataclass(slots=True, eq=False)
class _Waiting:
    keyframe: Keyframe
    position: Floats
    """(3,) m."""
    rotation: Floats
    """(9,), rows of camera to world."""
    wanted: bool = True


@dataclass(frozen=True, slots=True)
class Turn:
    """What comes next, in the order in which it was photographed."""

    passed_over: tuple[Keyframe, ...]
    """Only to be kept."""
    keyframes: tuple[Keyframe, ...]
    """To be mapped together; empty only if nothing waits."""


class KeyframeBacklog:
    def __init__(self, camera: Camera, waiting_max: int = WAITING_MAX, held_max: int = HELD_MAX) -> None:
        self._baseline_m, self._angle_rad = camera.keyframe_baseline_m, camera.keyframe_angle_rad
        self._waiting_max, self._held_max = waiting_max, held_max
        self._groups: deque[list[_Waiting]] = deque()
        self._mapped: deque[_Waiting] = deque(maxlen=COMPARED)
        self._held = 0
        self.waiting = 0
        """Keyframes that the map will get."""
        self.passed_over = 0
        """Those, so far, that it will not."""
        self.lost = 0
        """Those, so far, for which there was no room at all: the map stands still."""

    def put(self, keyframes: Sequence[Keyframe]) -> None:
        """Keyframes to be mapped together, not older than those before; if too many wait, some are passed over."""
        if self._held + len(keyframes) > self._held_max:
            self.lost += len(keyframes)
            return
        self._groups.append([_waiting(keyframe) for keyframe in keyframes])
        self._held += len(keyframes)
        self.waiting += len(keyframes)
        if self.waiting > self._waiting_max:
            self._pass_over(self.waiting - self._waiting_max)

    def take(self) -> Turn:
        """The oldest group that is to be mapped, and all before it that is not."""
        passed_over: list[Keyframe] = []
        wanted: list[_Waiting] = []
        while self._groups and not wanted:
            group = self._groups.popleft()
            self._held -= len(group)
            passed_over += (one.keyframe for one in group if not one.wanted)
            wanted = [one for one in group if one.wanted]
        self.waiting -= len(wanted)
        self._mapped += wanted
        return Turn(tuple(passed_over), tuple(one.keyframe for one in wanted))

    def _pass_over(self, count: int) -> None:
        candidates = [one for group in self._groups for one in group if one.wanted]
        distances = self._distances(candidates, [*candidates, *self._mapped])
        np.fill_diagonal(distances, np.inf)
        for _ in range(count):
            gaps = np.partition(distances, 1, axis=1)[:, :2].sum(axis=1)
            least = int(gaps.argmin())  # of equals the oldest
            candidates[least].wanted = False
            distances[least, :] = np.inf  # is not chosen again, ...
            distances[:, least] = np.inf  # ... and covers nothing any more
        self.waiting -= count
        self.passed_over += count

    def _distances(self, some: Sequence[_Waiting], others: Sequence[_Waiting]) -> NDArray[np.float64]:
        """(some, others): how far apart cameras are, in baselines and angles of the rule, added."""
        here, there = (np.array([one.position for one in each]) for each in (some, others))
        apart_m = np.linalg.norm(here[:, None] - there[None], axis=2)
        turns = np.array([one.rotation for one in some]) @ np.array([one.rotation for one in others]).T
        angles = np.arccos(np.clip((turns - 1) / 2, -1, 1))  # trace of R^T R' = 1 + 2 cos
        distances: NDArray[np.float64] = apart_m / self._baseline_m + angles / self._angle_rad
        return distances


def _waiting(keyframe: Keyframe) -> _Waiting:
    return _Waiting(keyframe, np.array(keyframe.position), np.array(keyframe.rotation).ravel())
