"""The strict rows that all planners share: what a planner wants goes through one quadratic program per tick.

An outcome other than solved brakes. Planners differ in what they want, never in what they may.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from agents.barriers import FIXED_ROWS, OBSTACLE, SEPARATION, ZONE, Barriers, Neighbour, Rows, predicted_pose
from agents.obstacles import Obstacles
from agents.planners.planner import STAY, Decision
from agents.quadratic_program import NOTHING_HELD, SECOND_TRY, SMOOTH, Held, QuadraticProgram, Smoothing
from protocol.airspace import airspace_of
from protocol.geometry import Floats
from protocol.mission import Mission
from protocol.separation import top_speed

WISH_WEIGHT = 1e3
"""How much more a wished velocity counts than effort: it is flown to a thousandth."""

ZONE_ROWS = 6
"""Room for parts of zones that are near at once; where there are more, a larger program is set up, in a millisecond."""
OBSTACLE_ROWS = 24
"""Likewise for obstacles, and by how much the program grows."""


class SafetyFilter:
    def __init__(self, mission: Mission, neighbours: int) -> None:
        """``neighbours``: as many as are expected."""
        self._mission = mission
        self._barriers = Barriers(mission)
        zones = 0 if airspace_of(mission.flight).is_open else ZONE_ROWS
        self._set_up(FIXED_ROWS + neighbours + zones)
        self._obstacles: Obstacles | None = None
        self._before: Floats = np.zeros(5)

    def heed(self, obstacles: Obstacles) -> None:
        """Rows of what is not free are strict as well from now on."""
        self._obstacles = obstacles
        self._barriers.heed(obstacles)
        self._set_up(self._program.strict_rows + OBSTACLE_ROWS)

    def note_deviation(self, deviation_m: float) -> None:
        """Standard deviation of the own position from now on."""
        self._barriers.note_deviation(deviation_m)

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
        smoothing: float = 0.0,
    ) -> Decision:
        """The velocity that meets ``xi1 . u + xi2 >= 0`` best, with the ``held`` axes as wished, at what speed and
        acceleration cost by ``smoothing``; the strict rows are never relaxed. ``sampling`` is passed on."""
        decision = self._solve(pose, velocity, neighbours, xi1, xi2, sampling, held, Smoothing(smoothing, velocity))
        self._before = decision.velocity
        return decision

    def _solve(
        self,
        pose: Floats,
        velocity: Floats,
        neighbours: Sequence[Neighbour],
        xi1: Floats,
        xi2: float,
        sampling: float,
        held: Held,
        smoothing: Smoothing,
    ) -> Decision:
        predicted = predicted_pose(pose, velocity, self._mission.flight)
        rows = self._barriers.rows(predicted, neighbours)
        low, high = self._barriers.velocity_bounds(velocity)
        if len(rows.names) > self._program.strict_rows:  # more zones are near, or somebody not in the mission is there
            self._set_up(len(rows.names) + (0 if self._obstacles is None else OBSTACLE_ROWS))
        program = self._smooth_program if smoothing.weight > 0 else self._program
        gentle = self._barriers.gentle_bounds(self._before, rows, low, high)
        solution = program.solve(xi1, xi2, rows, *gentle, held, smoothing)
        if solution.outcome in ("out_of_time", "numerical"):
            solution = self._second_program.solve(xi1, xi2, rows, *gentle, held, smoothing)
        if solution.outcome == "solved":
            return Decision(solution.velocity, "solved", solution.slack, sampling, rows, solution.active)
        return Decision(self.brake(rows, low, high), solution.outcome, 0.0, sampling, rows, ())

    def _set_up(self, strict_rows: int) -> None:
        settings = self._mission.controller
        self._program = self._smooth_program = QuadraticProgram(strict_rows, settings.effort_weight)
        self._second_program = QuadraticProgram(strict_rows, settings.effort_weight, SECOND_TRY)
        if settings.smoothing > 0:
            self._smooth_program = QuadraticProgram(strict_rows, settings.effort_weight, SMOOTH)

    def steer(self, pose: Floats, velocity: Floats, neighbours: Sequence[Neighbour], wish: Floats = STAY) -> Decision:
        """The same program with another question: xi1 . u + xi2 >= 0 means "as fast as ``wish``, along it", and nothing
        at all where the wish is to stay."""
        speed = float(np.linalg.norm(wish))
        along = wish / speed if speed > 0 else wish
        return self.solve(pose, velocity, neighbours, WISH_WEIGHT * along, -WISH_WEIGHT * speed)

    def brake(self, rows: Rows, low: Floats, high: Floats) -> Floats:
        """Stop; or, where strict rows are broken already, undo that as fast as the vehicle can: away from the nearest
        neighbour first, else out of zones and obstacles, else up past obstacles, else back into the box and the
        gimbal's range. Where each of these would break another row at that speed, it leaves obstacles as fast as it
        may."""
        slower: Floats = np.zeros(5)
        for kind, wish in self._retreats(rows):
            retreat: Floats = np.clip(wish, low, high)
            share = _allowed_share(rows, retreat)
            if share == 1.0:
                return retreat
            if kind == OBSTACLE and share * np.linalg.norm(retreat) > np.linalg.norm(slower):
                slower = share * retreat
        return slower

    def _retreats(self, rows: Rows) -> Iterator[tuple[str, Floats]]:
        """Velocities (5,) that undo what is broken, and of which kind that is, the most urgent first."""
        speed = top_speed(self._mission.flight)
        for kind, directions in (
            (SEPARATION, self._from_others(rows)),
            (ZONE, self._out_of(rows, ZONE)),
            (OBSTACLE, self._out_of(rows, OBSTACLE)),
            (OBSTACLE, self._up_past(rows)),
        ):
            for direction in directions:
                yield kind, speed * direction
        inwards: Floats = np.zeros(5)
        for k in np.flatnonzero(rows.barriers[:FIXED_ROWS] < 0):
            axis = int(np.abs(rows.coefficients[k]).argmax())  # each of these rows is about one
            inwards[axis] = rows.bounds[k] / rows.coefficients[k, axis]
        if inwards.any():
            yield "region", inwards

    def _from_others(self, rows: Rows) -> Iterator[Floats]:
        """The direction (5,) away from the nearest neighbour, if it is too near."""
        separation = rows.of(SEPARATION)
        if separation and rows.barriers[separation].min() < 0:
            yield from _directions(rows, [separation[int(rows.barriers[separation].argmin())]])

    def _out_of(self, rows: Rows, kind: str) -> Iterator[Floats]:
        """Directions (5,) out of those that it is in: of all together, then of the deepest one, and so on."""
        broken = [k for k in rows.of(kind) if rows.barriers[k] < 0]
        yield from _directions(rows, broken)
        if len(broken) > 1:
            for k in sorted(broken, key=lambda k: rows.barriers[k]):
                yield from _directions(rows, [k])

    def _up_past(self, rows: Rows) -> Iterator[Floats]:
        """Upwards, slid along the obstacles that it is in: between two of them there may be no other way out."""
        broken = [k for k in rows.of(OBSTACLE) if rows.barriers[k] < 0]
        if broken:
            up = np.array([0.0, 0.0, 1.0, 0.0, 0.0])
            for k in sorted(broken, key=lambda k: rows.barriers[k]):
                up -= min(0.0, float(rows.coefficients[k] @ up)) * rows.coefficients[k]
            yield up


def _directions(rows: Rows, chosen: list[int]) -> Iterator[Floats]:
    """The one in which the barriers of the ``chosen`` rows grow, of length 1; none if there is no such one."""
    growing: Floats = rows.coefficients[chosen].sum(axis=0)
    length = float(np.linalg.norm(growing))
    if length > 0:  # else every direction is as good as any
        yield growing / length


def _allowed_share(rows: Rows, velocity: Floats) -> float:
    """The largest part of ``velocity`` (5,), 0 to 1, that meets every row that can be met and takes no broken one
    further. Zero velocity does."""
    growth, least = rows.coefficients @ velocity, np.minimum(rows.bounds, 0.0)
    worse = growth < least
    return float((least[worse] / growth[worse]).min()) if worse.any() else 1.0
