"""The solver's answers against a general one, and its refusals."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.optimize import nnls

from agents.barriers import FIXED_ROWS, Barriers, Neighbour, Rows
from agents.quadratic_program import ACTIVE, EFFORT_FLOOR, TOLERANCE, Held, QuadraticProgram, Solution
from protocol.geometry import Floats
from protocol.mission import Drone, Flight, Mission
from protocol.separation import widened_separation

EFFORT = 0.01
ROOM = FIXED_ROWS + 4
NEAR = 1.2 * TOLERANCE / EFFORT_FLOOR
"""What the solver's residual allows for where the effort alone decides: 0.04 m/s or rad/s."""
BARRIERS = Barriers(Mission(drones=(Drone(id=1, start=(0, 1, 2, 0, 1.3)),)))


@dataclass(frozen=True)
class Problem:
    xi1: Floats
    xi2: float
    rows: Rows
    low: Floats
    high: Floats

    def solve(self, program: QuadraticProgram) -> Solution:
        return program.solve(self.xi1, self.xi2, self.rows, self.low, self.high)

    def slack(self, velocity: Floats) -> float:
        """The best w for a velocity."""
        return min(0.0, float(self.xi1 @ velocity) + self.xi2)

    def reference(self) -> Floats:
        """The best velocity, exactly: as a least distance problem by Lawson and Hanson, "Solving Least Squares
        Problems", chapter 23, in y = (sqrt(eps) u, w): minimise |y|^2 subject to A y >= b."""
        rows = np.vstack([np.append(self.xi1, -1.0), *(np.append(row, 0.0) for row in self.rows.coefficients)])
        rows = np.vstack([rows, np.eye(5, 6), -np.eye(5, 6)])
        bounds = np.concatenate([[-self.xi2], self.rows.bounds, self.low, -self.high])
        rows[:, :5] /= math.sqrt(EFFORT)
        length = np.maximum(np.linalg.norm(rows, axis=1), 1e-12)
        unit = max(1.0, abs(self.xi2))
        system = np.vstack([(rows / length[:, None]).T, bounds / length / unit])
        target = np.append(np.zeros(6), 1.0)
        residual = system @ nnls(system, target)[0] - target
        velocity: Floats = -unit * residual[:5] / residual[6] / math.sqrt(EFFORT)
        return velocity


def problem(seed: int, scale: float = 300.0) -> Problem:
    """As in flight: somewhere in the region among neighbours, with xi of some hundreds."""
    rng = np.random.default_rng(seed)
    lower, upper = [-4, -4, 0.5, -np.pi, np.pi / 3], [4, 4, 5, np.pi, np.pi / 2]
    pose = rng.uniform(lower, upper)
    neighbours = []
    for drone in range(2, 2 + int(rng.integers(0, 5))):
        direction = rng.normal(size=3)
        position = pose[:3] + direction / np.linalg.norm(direction) * rng.uniform(1.25, 4)
        neighbours.append(Neighbour(drone, position, 0.0))
    low, high = BARRIERS.velocity_bounds(rng.uniform(-0.5, 0.5, 5))
    xi1 = rng.normal(size=5) * rng.uniform(0.02, 1) * scale
    xi2 = -rng.uniform(-0.2, 1) * scale
    return Problem(xi1, xi2, BARRIERS.rows(pose, neighbours), low, high)


FREE = Problem(
    np.full(5, 100.0), -50.0, BARRIERS.rows(np.array([0, 0, 2, 0, 1.31]), []), np.full(5, -0.5), np.full(5, 0.5)
)


def program() -> QuadraticProgram:
    return QuadraticProgram(ROOM, EFFORT)


@pytest.mark.parametrize("scale", [1.0, 30.0, 300.0, 5000.0])
def test_the_answer_is_that_of_an_exact_method(scale: float) -> None:
    """Both where the sampling row falls short, and where it can be met and the effort alone decides."""
    warm = program()
    off, met = [], 0
    for seed in range(300):
        asked = problem(seed, scale)
        found, best = asked.solve(warm), asked.reference()

        assert found.outcome == "solved", seed
        least = asked.slack(best)
        assert found.slack == pytest.approx(least, abs=2e-3 * abs(asked.xi2)), seed
        assert np.abs(found.velocity - best).max() < NEAR, seed
        off.append(np.abs(found.velocity - best).max())
        met += least > -1e-3 * abs(asked.xi2)
    assert np.mean(off) < NEAR / 3
    assert 30 < met < 270


def test_strict_rows_and_bounds_hold_exactly() -> None:
    warm = program()
    for seed in range(400):
        asked = problem(seed)
        found = asked.solve(warm)

        assert found.outcome == "solved", seed
        assert (asked.rows.coefficients @ found.velocity >= asked.rows.bounds).all(), seed
        assert (found.velocity >= asked.low).all(), seed
        assert (found.velocity <= asked.high).all(), seed


def test_the_slack_is_what_the_sampling_row_lacks_and_never_positive() -> None:
    for seed in range(100):
        asked = problem(seed)
        found = asked.solve(program())

        assert found.slack == min(0.0, float(asked.xi1 @ found.velocity) + asked.xi2)
        assert found.slack <= 0


def test_a_wish_that_can_be_met_is_met_with_the_least_effort() -> None:
    found = FREE.solve(program())

    assert found.slack == pytest.approx(0.0, abs=0.1)
    assert found.velocity == pytest.approx(np.full(5, 0.1), abs=NEAR)


def test_nothing_to_wish_for_means_standing_still() -> None:
    still = Problem(np.zeros(5), 10.0, FREE.rows, FREE.low, FREE.high)

    found = still.solve(program())

    assert found.outcome == "solved"
    assert found.velocity == pytest.approx(np.zeros(5), abs=10 * TOLERANCE)
    assert found.slack == 0.0


def test_a_warm_start_finds_what_a_cold_one_does() -> None:
    warm = program()
    for seed in range(60):
        asked = problem(seed)
        cold, again = asked.solve(program()), asked.solve(warm)

        assert (cold.outcome, again.outcome) == ("solved", "solved")
        assert again.slack == pytest.approx(cold.slack, abs=2e-3 * abs(asked.xi2))
        assert again.velocity == pytest.approx(cold.velocity, abs=2 * NEAR)


def test_the_same_programs_give_the_same_bytes() -> None:
    one, other = program(), program()
    for seed in range(60):
        asked = problem(seed)
        assert asked.solve(one).velocity.tobytes() == asked.solve(other).velocity.tobytes()


def test_rows_that_cannot_all_hold_are_a_value_and_the_next_program_is_solved() -> None:
    surrounded = [
        Neighbour(2, np.array([0.2, 0, 2]), 0.0),
        Neighbour(3, np.array([-0.2, 0, 2]), 0.0),
    ]
    rows = BARRIERS.rows(np.array([0, 0, 2, 0, 1.3]), surrounded)
    stuck = Problem(FREE.xi1, FREE.xi2, rows, FREE.low, FREE.high)
    solver = program()

    found = stuck.solve(solver)

    assert found.outcome == "infeasible"
    assert not found.velocity.any()
    assert FREE.solve(solver).outcome == "solved"


def test_a_program_that_takes_too_long_is_a_value(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("agents.quadratic_program.MAX_ITERATIONS", 5)
    found = problem(3).solve(program())

    assert found.outcome == "out_of_time"
    assert not found.velocity.any()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", ["xi1", "xi2", "coefficients", "bounds", "low", "high"])
def test_a_number_that_is_not_finite_is_never_solved_and_does_no_lasting_harm(place: str, bad: float) -> None:
    solver = program()
    expected = FREE.solve(solver)
    xi1, low, high = FREE.xi1.copy(), FREE.low.copy(), FREE.high.copy()
    coefficients, bounds = FREE.rows.coefficients.copy(), FREE.rows.bounds.copy()
    for name, array in (("xi1", xi1), ("coefficients", coefficients), ("bounds", bounds), ("low", low), ("high", high)):
        if name == place:
            array.flat[3] = bad
    rows = Rows(FREE.rows.names, coefficients, bounds, FREE.rows.barriers)

    found = solver.solve(xi1, bad if place == "xi2" else FREE.xi2, rows, low, high)

    assert found.outcome == "numerical"
    assert np.isfinite(found.velocity).all()
    again = FREE.solve(solver)
    assert again.outcome == "solved"
    assert again.velocity == pytest.approx(expected.velocity, abs=NEAR)


def test_more_rows_than_there_is_room_for_are_an_error() -> None:
    with pytest.raises(ValueError, match="7 strict rows, but room for 6"):
        FREE.solve(QuadraticProgram(FIXED_ROWS - 1, EFFORT))


def test_rows_of_neighbours_that_are_gone_no_longer_bind() -> None:
    touching = Neighbour(2, np.array([widened_separation(Flight()), 0, 2]), 0.0)
    rows = BARRIERS.rows(np.array([0, 0, 2, 0, 1.31]), [touching])
    solver = program()

    beside = Problem(FREE.xi1, FREE.xi2, rows, FREE.low, FREE.high).solve(solver)
    alone = FREE.solve(solver)

    assert beside.velocity[0] <= 0.0
    assert "separation:2" in beside.active
    assert alone.velocity == pytest.approx(np.full(5, 0.1), abs=NEAR)
    assert "separation:2" not in alone.active


def test_active_names_the_rows_and_bounds_that_hold_with_equality() -> None:
    at_face = BARRIERS.rows(np.array([3.9999, 0, 2, 0, 1.31]), [])
    eager = Problem(np.array([900.0, 900, 0, 0, 0]), -2000.0, at_face, FREE.low, FREE.high)

    found = eager.solve(program())

    assert found.active == ("region:+x", "bound:y")
    assert found.velocity[0] < ACTIVE
    assert found.velocity[1] == pytest.approx(0.5, abs=ACTIVE)


HELD = Held(np.array([False, False, True, False, True]), np.array([9.0, 9.0, -0.2, 9.0, 0.1]))
"""Height and pitch; the other wishes mean nothing."""


@pytest.mark.parametrize("scale", [1.0, 300.0, 5000.0])
def test_held_axes_move_as_wished_and_the_others_as_if_these_were_not_there(scale: float) -> None:
    """Against the exact method with the held axes pinned by their bounds, where that is possible."""
    warm, compared = program(), 0
    for seed in range(200):
        asked = problem(seed, scale)
        xi1 = np.where(HELD.axes, 0.0, asked.xi1)
        pinned = Problem(
            xi1,
            asked.xi2,
            asked.rows,
            np.where(HELD.axes, HELD.wish, asked.low),
            np.where(HELD.axes, HELD.wish, asked.high),
        )
        found = warm.solve(xi1, asked.xi2, asked.rows, asked.low, asked.high, HELD)
        assert found.outcome == "solved", seed
        assert (asked.rows.coefficients @ found.velocity >= asked.rows.bounds).all(), seed
        if np.abs(found.velocity - HELD.wish)[HELD.axes].max() < 1e-3:  # else a strict row or a bound is in the way
            compared += 1
            assert found.slack == pytest.approx(pinned.slack(pinned.reference()), abs=2e-3 * abs(asked.xi2)), seed
    assert compared > 100


def test_a_strict_row_moves_a_held_axis_before_it_is_broken() -> None:
    below = Neighbour(2, np.array([0.0, 0.0, 1.0]), 0.0)
    rows = BARRIERS.rows(np.array([0, 0, 2, 0, 1.31]), [below])
    sinking = Held(np.ones(5, np.bool_), np.array([0.0, 0.0, -0.5, 0.0, 0.0]))

    found = program().solve(np.zeros(5), 0.0, rows, np.full(5, -0.5), np.full(5, 0.5), sinking)

    assert found.outcome == "solved"
    assert (rows.coefficients @ found.velocity >= rows.bounds).all()
    assert found.velocity[2] > 0, "away, because it is too near"
    assert np.abs(found.velocity[[0, 1, 3, 4]]).max() < 1e-3
