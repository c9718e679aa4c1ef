"""The team's states by tick: with eq. (2) deterministic, they are the log that every replica integrates phi from."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

import numpy as np

from protocol.geometry import Floats
from protocol.messages import DroneState

HISTORY_TICKS = 200
"""States older than this are forgotten; a tick is integrated long before."""


class StateLog:
    """Takes states of any drone in any order."""

    def __init__(self) -> None:
        self._poses: dict[int, dict[int, Sequence[float]]] = {}

    def hear(self, state: DroneState) -> None:
        self._poses.setdefault(state.tick, {})[state.drone] = state.pose

    def has_all(self, tick: int, drones: Collection[int]) -> bool:
        return self._poses.get(tick, {}).keys() >= set(drones)

    def poses_at(self, tick: int, drones: Iterable[int]) -> tuple[list[int], Floats]:
        """Ids in ascending order and poses (drones, 5) of those of ``drones`` whose state of ``tick`` is in."""
        known = self._poses.get(tick, {})
        ids = sorted(drone for drone in drones if drone in known)
        return ids, np.array([known[drone] for drone in ids]).reshape(len(ids), 5)

    def forget_before(self, tick: int) -> None:
        for old in [known for known in self._poses if known < tick - HISTORY_TICKS]:
            del self._poses[old]
