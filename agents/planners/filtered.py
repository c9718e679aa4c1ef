"""What is the same in all planners: whatever they want goes through the strict rows."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np

from agents.barriers import Neighbour
from agents.obstacles import Obstacles
from agents.planners.planner import STAY, Decision
from agents.planners.safety_filter import SafetyFilter
from protocol.geometry import Floats
from protocol.importance import SamplingTerms
from protocol.mission import Mission


class FilteredPlanner(ABC):
    """A `agents.planners.planner.Planner` that has yet to decide."""

    def __init__(self, mission: Mission, neighbours: int) -> None:
        """``neighbours``: as many as are expected."""
        self._mission = mission
        self._filter = SafetyFilter(mission, neighbours)

    def heed(self, obstacles: Obstacles) -> None:
        self._filter.heed(obstacles)

    def note_deviation(self, deviation_m: float) -> None:
        self._filter.note_deviation(deviation_m)

    @abstractmethod
    def decide(
        self, pose: Floats, velocity: Floats, neighbours: Sequence[Neighbour], terms: SamplingTerms, cells: float
    ) -> Decision: ...

    def note_team(self, drones: Sequence[int], poses: Floats) -> None:  # noqa: B027  # most need not know
        """For planners with a field of their own; phi itself is the agent's."""

    def steer(self, pose: Floats, velocity: Floats, neighbours: Sequence[Neighbour], wish: Floats = STAY) -> Decision:
        return self._filter.steer(pose, velocity, neighbours, wish)

    def rehearse(self) -> None:
        ids = [drone.id for drone in self._mission.drones]
        self.note_team(ids, np.zeros((len(ids), 5)))
        neighbour = Neighbour(drone=0, position=np.full(3, 1e3), age_s=0.0)
        self.decide(np.zeros(5), np.zeros(5), [neighbour], SamplingTerms(np.ones(5), 1.0, 1.0), 1.0)
