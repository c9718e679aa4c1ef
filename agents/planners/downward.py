"""Drones in a plane with cameras straight down: x and y are all that a sampling row moves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agents.barriers import Neighbour
from agents.planners.filtered import FilteredPlanner
from agents.planners.planner import Decision
from agents.planners.posture import Posture
from agents.quadratic_program import Held
from protocol.geometry import Floats
from protocol.mission import Mission

_HELD = np.array([False, False, True, True, True])
_ALL = np.ones(5, np.bool_)


class DownwardPlanner(FilteredPlanner):
    """A planner that has yet to decide by which sampling row it moves."""

    def __init__(self, mission: Mission, neighbours: int) -> None:
        super().__init__(mission, neighbours)
        self._posture = Posture(mission)

    def _pursue(
        self,
        pose: Floats,
        velocity: Floats,
        neighbours: Sequence[Neighbour],
        xi1: Floats,
        xi2: float,
        sampling: float,
    ) -> Decision:
        """The row's x and y with height and camera held; in place while the camera is still turning down. The yaw stays
        as it is: seen from straight above it is all the same."""
        wish = self._posture.downward(pose)
        if self._posture.is_turned(wish):
            held, xi1 = _HELD, np.where(_HELD, 0.0, xi1)
        else:
            held, xi1, xi2 = _ALL, np.zeros(5), 0.0
        return self._filter.solve(pose, velocity, neighbours, xi1, xi2, sampling=sampling, held=Held(held, wish))
