"""The paper's controller: one drone's velocity for the next tick, from its own cells and its neighbours.

`Planner` is what every method behind the same safety rows offers; baselines differ in how they want to move.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from agents.barriers import FIXED_ROWS, Barriers, Neighbour, Rows, predicted_pose
from agents.quadratic_program import Outcome, QuadraticProgram
from protocol.geometry import Floats
from protocol.importance import SamplingTerms
from protocol.mission import Mission
from protocol.separation import top_speed

WISH_WEIGHT = 1e3
"""How much more a wished velocity counts than effort: it is flown to a thousandth."""

STAY: Floats = np.zeros(5)


@dataclass(frozen=True, slots=True)
class Decision:
    """The velocity to fly and why."""

    velocity: Floats
    """(5,) m/s and rad/s, world frame."""
    outcome: Outcome
    slack: float
    sampling: float
    """I_i = sum of delta_1 h1 phi over the drone's own cells, 1/s."""
    rows: Rows
    active: tuple[str, ...]


class Planner(Protocol):
    def decide(
        self, pose: Floats, velocity: Floats, neighbours: Sequence[Neighbour], terms: SamplingTerms, cells: float
    ) -> Decision:
        """Own ``pose`` and ``velocity`` (5,); the field's ``terms``; ``cells`` = |V_i|."""
        ...

    def steer(self, pose: Floats, velocity: Floats, neighbours: Sequence[Neighbour], wish: Floats = STAY) -> Decision:
        """Fly ``wish`` (5,), as far as the strict rows allow; they may also make a drone that stays give way."""
        ...


class CoverageController:
    """Coverage-Recon's QP-based controller with strict safety rows."""

    def __init__(self, mission: Mission, neighbours: int) -> None:
        """``neighbours``: as many as are expected."""
        self._mission = mission
        self._barriers = Barriers(mission)
        self._program = QuadraticProgram(FIXED_ROWS + neighbours, mission.controller.effort_weight)

    def decide(
        self, pose: Floats, velocity: Floats, neighbours: Sequence[Neighbour], terms: SamplingTerms, cells: float
    ) -> Decision:
        settings = self._mission.controller
        a1, decay = settings.sampling_gain_per_s, self._mission.sensing.decay_per_s

        # Sampling row, eqs. (15a) and (15b): keep b = I_i - |V_i| gamma from falling below zero, up to the slack.
        xi1 = decay * terms.gradient
        sampling = decay * terms.first
        xi2 = a1 * (sampling - cells * settings.coverage_rate_per_s) - decay * decay * terms.second
        return self._filter(pose, velocity, neighbours, xi1, xi2, sampling)

    def steer(self, pose: Floats, velocity: Floats, neighbours: Sequence[Neighbour], wish: Floats = STAY) -> Decision:
        """The same program with another question: xi1 . u + xi2 >= 0 means "as fast as ``wish``, along it", and nothing
        at all where the wish is to stay."""
        speed = float(np.linalg.norm(wish))
        along = wish / speed if speed > 0 else wish
        return self._filter(pose, velocity, neighbours, WISH_WEIGHT * along, -WISH_WEIGHT * speed, 0.0)

    def _filter(
        self,
        pose: Floats,
        velocity: Floats,
        neighbours: Sequence[Neighbour],
        xi1: Floats,
        xi2: float,
        sampling: float,
    ) -> Decision:
        """The velocity that meets ``xi1 . u + xi2 >= 0`` best; the strict rows are never relaxed."""
        settings, flight = self._mission.controller, self._mission.flight
        predicted = predicted_pose(pose, velocity, flight)
        rows = self._barriers.rows(predicted, neighbours)
        low, high = self._barriers.velocity_bounds(velocity)
        if len(rows.names) > self._program.strict_rows:  # somebody who is not in the mission was heard of
            self._program = QuadraticProgram(len(rows.names), settings.effort_weight)
        solution = self._program.solve(xi1, xi2, rows, low, high)
        if solution.outcome == "solved":
            return Decision(solution.velocity, "solved", solution.slack, sampling, rows, solution.active)
        return Decision(self.brake(rows, low, high), solution.outcome, 0.0, sampling, rows, ())

    def rehearse(self) -> None:
        """Decide once at no place in particular, so that nothing is left to be compiled in flight."""
        neighbour = Neighbour(drone=0, position=np.full(3, 1e3), age_s=0.0)
        self.decide(np.zeros(5), np.zeros(5), [neighbour], SamplingTerms(np.ones(5), 1.0, 1.0), 1.0)

    def brake(self, rows: Rows, low: Floats, high: Floats) -> Floats:
        """Stop; or, where strict rows are broken already, undo that as fast as the vehicle can, unless another row
        forbids it: away from the nearest neighbour first, else back into the region and the gimbal's range."""
        separation = rows.barriers[FIXED_ROWS:]
        if separation.size and separation.min() < 0:
            offset = rows.coefficients[FIXED_ROWS + int(separation.argmin())]
            distance = float(np.linalg.norm(offset))
            if distance > 0:  # else every direction is as good as any
                retreat: Floats = np.clip(offset / distance * top_speed(self._mission.flight), low, high)
                if _worsens_nothing(rows, retreat):
                    return retreat
        inwards: Floats = np.zeros(5)
        for k in np.flatnonzero(rows.barriers[:FIXED_ROWS] < 0):
            axis = int(np.abs(rows.coefficients[k]).argmax())  # each of these rows is about one
            inwards[axis] = rows.bounds[k] / rows.coefficients[k, axis]
        inwards = np.clip(inwards, low, high)
        return inwards if _worsens_nothing(rows, inwards) else np.zeros(5)


def _worsens_nothing(rows: Rows, velocity: Floats) -> bool:
    """Whether ``velocity`` (5,) meets every row that can be met, and takes no broken one further."""
    return bool((rows.coefficients @ velocity >= np.minimum(rows.bounds, 0.0)).all())
