"""The team's states by tick: with eq. (2) deterministic, they are the log that every replica integrates phi from."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

import numpy as np

from protocol.geometry import Floats
from protocol.messages import DroneState
from protocol.team_states import Sighting

HISTORY_TICKS = 200
"""States older than this are forgotten; a tick is integrated long before."""


class StateLog:
    """Takes states of any drone in any order."""

    def __init__(self) -> None:
        self._poses: dict[int, dict[int, Sequence[float]]] = {}
        self._newest: dict[int, tuple[int, Sequence[float]]] = {}

    def hear(self, state: DroneState | Sighting) -> None:
        """Also the poses of earlier ticks that it repeats, in case their own messages were lost."""
        for tick, pose in (*state.earlier, (state.tick, state.pose)):
            self._poses.setdefault(tick, {})[state.drone] = pose
        if state.tick >= self._newest.get(state.drone, (-1,))[0]:
            self._newest[state.drone] = (state.tick, state.pose)

    def has_all(self, tick: int, drones: Collection[int]) -> bool:
        return self._poses.get(tick, {}).keys() >= set(drones)

    def poses_at(self, tick: int, drones: Iterable[int]) -> tuple[list[int], Floats]:
        """Ids in ascending order and poses (drones, 5) of those of ``drones`` whose state of ``tick`` is in."""
        return _table(self._poses.get(tick, {}), drones)

    def newest(self, drones: Iterable[int]) -> tuple[list[int], Floats]:
        """Likewise the last pose heard of each."""
        return _table({drone: pose for drone, (_, pose) in self._newest.items()}, drones)

    def forget_before(self, tick: int) -> None:
        for old in [known for known in self._poses if known < tick - HISTORY_TICKS]:
            del self._poses[old]


def _table(known: dict[int, Sequence[float]], drones: Iterable[int]) -> tuple[list[int], Floats]:
    ids = sorted(drone for drone in drones if drone in known)
    return ids, np.array([known[drone] for drone in ids]).reshape(len(ids), 5)
