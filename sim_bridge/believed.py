"""Where drones believe to be, beside where they are: what a camera sees comes from this, its pose from that."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from protocol.geometry import Floats
from protocol.messages import DroneState
from sim_bridge.photographer import Sight

KEPT_TICKS = 20
"""How long after its tick a state may come; a second of 20 Hz."""


class BelievedPoses:
    def __init__(self) -> None:
        self._truths: dict[int, Mapping[int, Floats]] = {}
        self._velocities: dict[int, Mapping[int, Floats]] = {}
        self._newest: dict[int, DroneState] = {}
        self._taken: dict[int, int] = {}

    def note_truth(self, tick: int, poses: Mapping[int, Floats], velocities: Mapping[int, Floats]) -> None:
        """``poses`` and ``velocities`` (5,) by drone."""
        for kept, told in (self._truths, poses), (self._velocities, velocities):
            kept[tick] = {drone: vector.copy() for drone, vector in told.items()}
            kept.pop(tick - KEPT_TICKS, None)

    def hear(self, state: DroneState) -> None:
        known = self._newest.get(state.drone)
        if known is None or state.tick > known.tick:
            self._newest[state.drone] = state

    def has(self, tick: int, drones: Iterable[int]) -> bool:
        """Whether all of ``drones`` have said where they believed to be at ``tick``."""
        return all(drone in self._newest and self._newest[drone].tick >= tick for drone in drones)

    def take(self) -> list[Sight]:
        """Of what was said since the last time the newest of each drone, ascending by drone."""
        sights = []
        for drone, state in sorted(self._newest.items()):
            truth = self._truths.get(state.tick, {}).get(drone)
            if truth is None or state.tick <= self._taken.get(drone, -1):
                continue
            self._taken[drone] = state.tick
            deviations = state.position_sd_m, state.angle_sd_rad
            sights.append(
                Sight(drone, state.tick, truth, np.array(state.pose), deviations, self._velocities[state.tick][drone])
            )
        return sights
