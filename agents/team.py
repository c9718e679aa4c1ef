"""The other drones as obstacles: whoever was once heard of, or is in the mission, never vanishes by falling silent."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from agents.barriers import Neighbour, predicted_pose
from protocol.geometry import Floats
from protocol.messages import DroneState
from protocol.mission import Flight


class Team:
    """``starts`` are poses (5,) of the whole team, so that a drone that never speaks is an obstacle at its start."""

    def __init__(self, own: int, starts: Mapping[int, Floats], flight: Flight, tick_s: float) -> None:
        self._own, self._flight, self._tick_s = own, flight, tick_s
        self._last_seen = {drone: (0, start) for drone, start in starts.items() if drone != own}

    def hear(self, state: DroneState) -> None:
        """An older state never replaces a newer one."""
        if state.drone == self._own or self._last_seen.get(state.drone, (0, None))[0] > state.tick:
            return
        predicted = predicted_pose(np.array(state.pose), np.array(state.velocity), self._flight)
        self._last_seen[state.drone] = (state.tick, predicted)

    def neighbours(self, tick: int) -> list[Neighbour]:
        """All the others at ``tick``, ascending by id; the longer silent, the larger."""
        return [
            Neighbour(drone, predicted[:3], max(0, tick - seen) * self._tick_s)
            for drone, (seen, predicted) in sorted(self._last_seen.items())
        ]
