"""The strict rows that all planners share: what a planner wants goes through one quadratic program per tick.

An outcome other than solved brakes. Planners differ in what they want, never in what they may.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agents.barriers import FIXED_ROWS, Barriers, Neighbour, Rows, predicted_pose
from agents.planners.planner import STAY, Decision
from agents.quadratic_program import NOTHING_HELD, Held, QuadraticProgram
from protocol.geometry import Floats
from protocol.mission import Mission
from protocol.separation import top_speed

WISH_WEIGHT = 1e3
"""How much more a wished velocity counts than effort: it is flown to a thousandth."""


class SafetyFilter:
    def __init__(self, mission: Mission, neighbours: int) -> None:
        """``neighbours``: as many as are expected."""
        self._mission = mission
        self._barriers = Barriers(mission)
        self._program = QuadraticProgram(FIXED_ROWS + neighbours, mission.controller.effort_weight)

    def solve(
        self,
        pose: Floats,
        velocity: Floats,
        neighbours: Sequence[Neighbour],
        xi1: Floats,
        xi2: float,
        *,
        sampling: float = 0.0,
        held: Held = NOTHING_HELD,
    ) -> Decision:
        """The velocity that meets ``xi1 . u + xi2 >= 0`` best, with the ``held`` axes as wished; the strict rows are
        never relaxed. ``sampling`` is passed on."""
        settings, flight = self._mission.controller, self._mission.flight
        predicted = predicted_pose(pose, velocity, flight)
        rows = self._barriers.rows(predicted, neighbours)
        low, high = self._barriers.velocity_bounds(velocity)
        if len(rows.names) > self._program.strict_rows:  # somebody who is not in the mission was heard of
            self._program = QuadraticProgram(len(rows.names), settings.effort_weight)
        solution = self._program.solve(xi1, xi2, rows, low, high, held)
        if solution.outcome == "solved":
            return Decision(solution.velocity, "solved", solution.slack, sampling, rows, solution.active)
        return Decision(self.brake(rows, low, high), solution.outcome, 0.0, sampling, rows, ())

    def steer(self, pose: Floats, velocity: Floats, neighbours: Sequence[Neighbour], wish: Floats = STAY) -> Decision:
        """The same program with another question: xi1 . u + xi2 >= 0 means "as fast as ``wish``, along it", and nothing
        at all where the wish is to stay."""
        speed = float(np.linalg.norm(wish))
        along = wish / speed if speed > 0 else wish
        return self.solve(pose, velocity, neighbours, WISH_WEIGHT * along, -WISH_WEIGHT * speed)

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
