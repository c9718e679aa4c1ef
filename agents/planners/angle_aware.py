"""Angle-aware coverage with a camera that turns: the paper's controller before it could change its height.

Source: Z. Lu, M. Hanif, T. Shimizu, T. Hatanaka, "Angle-Aware Coverage with Camera Rotational Motion Control",
arXiv:2404.13915 (2024), as Coverage-Recon compares with it. Taken from it: a drone moves in a plane of fixed height and
turns its camera, four inputs, by a quadratic program whose soft row bounds from below how fast the importance of
position-and-direction cells decays. Ours: sensing is h1 of Coverage-Recon's eq. (1), for which one field judges all
methods, where theirs has a performance function of its own; the height is held softly, so that it never makes the
program infeasible; and the strict rows are those of all planners.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agents.barriers import Neighbour
from agents.planners.coverage import sampling_row
from agents.planners.filtered import FilteredPlanner
from agents.planners.planner import Decision
from agents.planners.posture import Posture
from agents.quadratic_program import Held
from protocol.geometry import Floats
from protocol.importance import SamplingTerms
from protocol.mission import Mission
from protocol.planner_settings import FREE_AXES

_HELD = ~np.array(FREE_AXES["angle_aware"])


class AngleAware(FilteredPlanner):
    def __init__(self, mission: Mission, neighbours: int) -> None:
        super().__init__(mission, neighbours)
        self._posture = Posture(mission)

    def decide(
        self, pose: Floats, velocity: Floats, neighbours: Sequence[Neighbour], terms: SamplingTerms, cells: float
    ) -> Decision:
        xi1, xi2 = sampling_row(self._mission, terms, cells * self._mission.controller.coverage_rate_per_s)
        return self._filter.solve(
            pose,
            velocity,
            neighbours,
            np.where(_HELD, 0.0, xi1),
            xi2,
            sampling=self._mission.sensing.decay_per_s * terms.first,
            held=Held(_HELD, self._posture.level(pose)),
        )
