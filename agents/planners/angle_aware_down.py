"""Angle-aware coverage with a fixed camera: directions of view are had by flying to where they are seen from.

Source: T. Shimizu, S. Yamashita, T. Hatanaka, K. Uto, M. Mammarella, F. Dabbene, "Angle-Aware Coverage Control for 3-D
Map Reconstruction With Drone Networks", IEEE Control Systems Letters 6 (2021), as Coverage-Recon compares with it.
Taken from it: a drone moves in a plane of fixed height with its camera straight down, two inputs, by a quadratic
program whose soft row bounds from below how fast the importance of position-and-direction cells decays. Ours: sensing
is h1 of Coverage-Recon's eq. (1), for which one field judges all methods, where theirs is a Gaussian around the one
place from which a cell is seen as wished; the camera is first turned down in place; height and camera are held softly,
and the strict rows are those of all planners.
"""

from __future__ import annotations

from collections.abc import Sequence

from agents.barriers import Neighbour
from agents.planners.coverage import sampling_row
from agents.planners.downward import DownwardPlanner
from agents.planners.planner import Decision
from protocol.geometry import Floats
from protocol.importance import SamplingTerms


class AngleAwareDown(DownwardPlanner):
    def decide(
        self, pose: Floats, velocity: Floats, neighbours: Sequence[Neighbour], terms: SamplingTerms, cells: float
    ) -> Decision:
        xi1, xi2 = sampling_row(self._mission, terms, cells * self._mission.controller.coverage_rate_per_s)
        return self._pursue(pose, velocity, neighbours, xi1, xi2, self._mission.sensing.decay_per_s * terms.first)
