"""The controller asks the paper's question, and brakes on any answer but "solved"."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import get_args

import numpy as np
import pytest

from agents.barriers import FIXED_ROWS, Neighbour, Rows, predicted_pose
from agents.planners.coverage import CoverageController
from agents.planners.planner import Decision
from agents.quadratic_program import Held, Outcome, Smoothing, Solution
from protocol.field import VirtualField
from protocol.geometry import Floats, optical_axis
from protocol.importance import ImportanceField, SamplingTerms
from protocol.mission import Controller, Drone, Mission, Sensing, Target

GAMMA, A1 = 0.02, 1.5
MISSION = Mission(
    target=Target(cell_m=0.4, cell_rad=0.5),
    sensing=Sensing(exponent_cut=60.0),
    controller=Controller(coverage_rate_per_s=GAMMA, sampling_gain_per_s=A1),
    drones=(Drone(id=1, start=(0, 1, 2, 0, 1.3)),),
)
POSE = np.array([0.2, -0.3, 1.4, 0.7, 1.25])
STILL = np.zeros(5)
DOWN = np.array([0.0, 0.0, -0.3, 0.0, 0.0])
WISH = SamplingTerms(np.full(5, 300.0), 20.0, 5.0)
CELLS = 30_000.0


@dataclass
class ScriptedProgram:
    """Stands in for the solver: notes what it is asked and gives the answer it was made with."""

    answer: Solution
    strict_rows: int = 99
    asked: list[tuple[Floats, float, Rows]] = field(default_factory=list)

    def solve(
        self, xi1: Floats, xi2: float, rows: Rows, low: Floats, high: Floats, held: Held, smoothing: Smoothing
    ) -> Solution:
        assert (low <= high).all()
        assert not held.axes.any(), "the paper's controller leaves every axis to the sampling row"
        assert smoothing.weight == 0, "nor does it smooth anything"
        self.asked.append((xi1, xi2, rows))
        return self.answer


def decide(
    outcome: Outcome,
    neighbours: list[Neighbour],
    pose: Floats = POSE,
    velocity: Floats = STILL,
    terms: SamplingTerms = WISH,
    mission: Mission = MISSION,
) -> tuple[Decision, ScriptedProgram]:
    """One decision of a controller whose solver says ``outcome`` and, whatever it says, a velocity and a slack."""
    controller = CoverageController(mission, neighbours=2)
    program = ScriptedProgram(Solution(outcome, np.full(5, 0.3), -7.0, ("bound:x",)))
    controller._filter._program = controller._filter._second_program = program  # type: ignore[assignment]
    return controller.decide(pose, velocity, neighbours, terms, CELLS), program


def beside(drone: int, x: float, y: float, z: float) -> Neighbour:
    """A neighbour at an offset from `POSE`, metres."""
    return Neighbour(drone, POSE[:3] + np.array([x, y, z]), 0.0)


def test_what_the_solver_solved_is_flown() -> None:
    decision, _ = decide("solved", [])

    assert decision.velocity.tolist() == [0.3] * 5
    assert (decision.outcome, decision.slack, decision.active) == ("solved", -7.0, ("bound:x",))


@pytest.mark.parametrize("outcome", [outcome for outcome in get_args(Outcome) if outcome != "solved"])
def test_any_other_outcome_brakes_and_is_told(outcome: Outcome) -> None:
    far = Neighbour(2, np.array([3.0, 3.0, 3.0]), 0.0)

    decision, _ = decide(outcome, [far])

    assert not decision.velocity.any()
    assert decision.outcome == outcome
    assert (decision.slack, decision.active) == (0.0, ())


@pytest.mark.parametrize("outcome", [outcome for outcome in get_args(Outcome) if outcome != "solved"])
@pytest.mark.parametrize("offset", [(0.5, 0.0, 0.0), (-0.3, 0.4, 0.1), (0.0, 0.0, -0.6)])
def test_a_drone_that_is_too_near_moves_away_instead_of_standing_there(
    outcome: Outcome, offset: tuple[float, float, float]
) -> None:
    near, far = beside(2, *offset), beside(3, 0, 0, 3)

    decision, _ = decide(outcome, [far, near])

    away = -np.array(offset) / np.linalg.norm(offset)
    assert decision.velocity[:3] @ away > 0.4
    assert np.abs(decision.velocity).max() <= 0.5
    assert not decision.velocity[3:].any()


def test_of_two_that_are_too_near_the_nearest_is_fled() -> None:
    left, right = beside(2, 0, 0.8, 0), beside(3, 0.5, 0, 0)

    decision, _ = decide("infeasible", [left, right])

    assert decision.velocity.tolist() == [-0.5, 0, 0, 0, 0]


def test_a_drone_between_two_stands_still_rather_than_flee_into_the_other() -> None:
    one, other = beside(2, 0.5, 0, 0), beside(3, -0.6, 0, 0)

    decision, _ = decide("infeasible", [one, other])

    assert not decision.velocity.any()


def test_a_drone_flees_also_when_another_row_is_violated_more() -> None:
    """Barriers of different rows have different units: a metre outside of the region is not worse than a collision."""
    outside = np.array([5.5, 0.0, 2.0, 0.0, 1.3])

    decision, _ = decide("infeasible", [Neighbour(2, np.array([6.0, 0.0, 2.0]), 0.0)], pose=outside)

    assert decision.velocity.tolist() == [-0.5, 0, 0, 0, 0]


def test_a_drone_does_not_flee_out_of_its_region() -> None:
    at_face = np.array([-4.0, 0.0, 2.0, 0.0, 1.3])

    decision, _ = decide("infeasible", [Neighbour(2, np.array([-3.5, 0.0, 2.0]), 0.0)], pose=at_face)

    assert not decision.velocity.any()


def test_two_drones_at_the_very_same_place_stand_still() -> None:
    decision, _ = decide("numerical", [beside(2, 0, 0, 0)])

    assert decision.velocity.tolist() == [0.0] * 5


def test_telemetry_that_is_no_number_brakes() -> None:
    controller = CoverageController(MISSION, neighbours=1)
    lost = np.array([np.nan, 0, 2, 0, 1.3])

    decision = controller.decide(lost, STILL, [Neighbour(2, np.array([1.0, 0, 2]), 0.0)], WISH, CELLS)

    assert decision.outcome == "numerical"
    assert decision.velocity.tolist() == [0.0] * 5
    assert controller.decide(POSE, STILL, [], WISH, CELLS).outcome == "solved"


def test_more_neighbours_than_expected_are_all_kept_clear_of() -> None:
    controller = CoverageController(MISSION, neighbours=1)
    angles = np.arange(5) * 2 * math.pi / 5
    ring = [beside(k + 2, 1.2 * math.cos(angle), 1.2 * math.sin(angle), 0) for k, angle in enumerate(angles)]

    decision = controller.decide(POSE, STILL, ring, WISH, CELLS)

    assert decision.outcome == "solved"
    assert len(decision.rows.names) == FIXED_ROWS + 5
    assert (decision.rows.coefficients @ decision.velocity >= decision.rows.bounds).all()


def test_rows_are_those_of_the_predicted_pose() -> None:
    velocity = np.array([0.5, 0.0, 0.0, 0.0, -0.2])

    _, program = decide("solved", [], velocity=velocity)

    predicted = predicted_pose(POSE, velocity, MISSION.flight)
    (_, _, rows) = program.asked[0]
    assert rows.barriers[1:4] == pytest.approx(predicted[:3] - MISSION.flight.lower_m)


def dense_h1(pose: Floats, cells: VirtualField) -> Floats:
    """Eq. (1) for every cell, (positions, directions), as the paper prints it."""
    sensing = MISSION.sensing
    to_cell = cells.positions() - pose[:3]
    r = np.linalg.norm(to_cell, axis=1)
    sight = to_cell / r[:, None]
    along, view = sight @ optical_axis(pose[3], pose[4]), -sight @ cells.directions.T
    position = (1 - along) ** 2 / (2 * sensing.sigma_axis**2)
    position += (r - sensing.distance_m) ** 2 / (2 * sensing.sigma_distance_m**2)
    h1: Floats = np.exp(-position[:, None] - (1 - view) ** 2 / (2 * sensing.sigma_view**2))
    return h1


@pytest.mark.parametrize("seed", range(4))
def test_the_sampling_row_is_the_barrier_condition_of_the_drones_own_share_of_the_decay(seed: int) -> None:
    """b = I_i - |V_i| gamma with I_i = sum of delta_1 h1 phi over V_i: the row says db/dt + a1 b >= w.

    db/dt by finite differences of the dense I_i along a velocity, while phi decays by eq. (2), V_i held.
    """
    rng = np.random.default_rng(seed)
    cells = VirtualField.of(MISSION.target)
    poses = POSE + np.array([[0, 0, 0, 0, 0], [0.5, 0.4, 0.2, 0.3, 0.1]])
    replica = ImportanceField(cells, MISSION.sensing)
    replica.phi[:] = rng.uniform(0, 2, cells.shape)
    phi = replica.phi.astype(np.float64)
    h1 = np.stack([dense_h1(pose, cells) for pose in poses])
    mine = h1[0] >= h1[1]
    decay = MISSION.sensing.decay_per_s

    def share(time_s: float, velocity: Floats) -> float:
        faded = phi * np.exp(-decay * time_s * h1[0])
        return float((decay * dense_h1(POSE + time_s * velocity, cells) * faded)[mine].sum())

    decision, program = decide("solved", [], terms=replica.advance(poses, MISSION.tick_s, own=0))
    (xi1, xi2, _) = program.asked[0]

    assert decision.sampling == pytest.approx(share(0.0, STILL), rel=1e-4)
    for velocity in (STILL, *rng.uniform(-0.5, 0.5, (4, 5))):
        step = 1e-5
        rate = (share(step, velocity) - share(-step, velocity)) / (2 * step)
        expected = rate + A1 * (share(0.0, STILL) - CELLS * GAMMA)
        assert float(xi1 @ velocity) + xi2 == pytest.approx(expected, rel=1e-4, abs=1e-4 * np.abs(xi1).sum())


def test_without_a_wish_a_drone_stays_where_it_is() -> None:
    decision = CoverageController(MISSION, neighbours=1).steer(POSE, STILL, [beside(2, 2.0, 0.0, 0.0)])

    assert decision.outcome == "solved"
    assert np.abs(decision.velocity).max() < 1e-4


def test_a_drone_that_holds_gives_way_to_one_that_is_too_near() -> None:
    decision = CoverageController(MISSION, neighbours=1).steer(POSE, STILL, [beside(2, 0.9, 0.0, 0.0)])

    assert decision.velocity[0] < 0, "away from it"


def test_a_wished_descent_is_flown_as_far_as_the_strict_rows_allow() -> None:
    controller = CoverageController(MISSION, neighbours=1)
    free = controller.steer(POSE, STILL, [beside(2, 2.0, 0.0, 0.0)], DOWN)
    blocked = controller.steer(POSE, STILL, [beside(2, 0.0, 0.0, -1.1)], DOWN)

    assert free.velocity[2] == pytest.approx(-0.3, rel=0.01)
    assert np.abs(free.velocity[:2]).max() < 0.01
    assert blocked.velocity[2] > -0.15


def test_a_drone_far_outside_its_region_comes_back_as_fast_as_it_can() -> None:
    pose = np.array([4.9, 0.0, 0.1, 0.7, 1.25])  # flight region: x to 4, z from 0.5
    decision = CoverageController(MISSION, neighbours=1).steer(pose, STILL, [])

    assert decision.outcome == "infeasible", "the row wants more than the vehicle can"
    assert decision.velocity == pytest.approx([-0.5, 0.0, 0.4, 0.0, 0.0], abs=1e-6)


def test_a_camera_outside_its_range_turns_back() -> None:
    decision = CoverageController(MISSION, neighbours=1).steer(np.array([0.0, 0.0, 2.0, 0.0, 0.2]), STILL, [])

    assert decision.outcome == "infeasible"
    assert decision.velocity == pytest.approx([0.0, 0.0, 0.0, 0.0, 0.5])


def test_nobody_comes_back_through_a_neighbour() -> None:
    pose = np.array([4.9, 0.0, 2.0, 0.7, 1.25])
    decision = CoverageController(MISSION, neighbours=1).steer(
        pose, STILL, [Neighbour(2, pose[:3] - [1.28, 0.0, 0.0], 0.0)]
    )

    assert decision.outcome == "infeasible"
    assert np.abs(decision.velocity).max() == 0
