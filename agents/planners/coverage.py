"""The paper's controller: one drone's velocity for the next tick, from its own cells and its neighbours.

Source: "Coverage-Recon: Coordinated Multi-Drone Image Sampling with Online Map Feedback", its QP-based controller; the
departures from the print are listed in ARCHITECTURE.md.
"""

from __future__ import annotations

from collections.abc import Sequence

from agents.barriers import Neighbour
from agents.planners.filtered import FilteredPlanner
from agents.planners.planner import Decision
from protocol.geometry import Floats
from protocol.importance import SamplingTerms
from protocol.mission import Mission


class CoverageController(FilteredPlanner):
    """Coverage-Recon's QP-based controller with strict safety rows."""

    def decide(
        self, pose: Floats, velocity: Floats, neighbours: Sequence[Neighbour], terms: SamplingTerms, cells: float
    ) -> Decision:
        xi1, xi2 = sampling_row(self._mission, terms, cells * self._mission.controller.coverage_rate_per_s)
        sampling = self._mission.sensing.decay_per_s * terms.first
        smoothing = self._mission.controller.smoothing
        return self._filter.solve(pose, velocity, neighbours, xi1, xi2, sampling=sampling, smoothing=smoothing)


def sampling_row(mission: Mission, terms: SamplingTerms, wished: float) -> tuple[Floats, float]:
    """xi1 (5,) and xi2 of eqs. (15a) and (15b): keep b = I_i - |V_i| gamma from falling below zero, up to the slack.

    ``wished`` = |V_i| gamma, 1/s.
    """
    settings, decay = mission.controller, mission.sensing.decay_per_s
    xi2 = settings.sampling_gain_per_s * (decay * terms.first - wished)
    return decay * terms.gradient, xi2 - decay * decay * terms.second
