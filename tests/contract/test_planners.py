"""What every planner promises, whatever it wants: the strict rows, the bounds, the same answer to the same question."""

from __future__ import annotations

import math
from typing import get_args

import numpy as np
import pytest

from agents.barriers import Barriers, Neighbour, predicted_pose
from agents.planners.choice import make_planner
from agents.planners.planner import Planner
from agents.quadratic_program import Outcome, Solution
from faults.team_flight import TeamFlight
from protocol.geometry import Floats
from protocol.importance import SamplingTerms, compile_kernels
from protocol.mission import Controller, Drone, Flight, Mission
from protocol.planner_settings import DOWNWARD, PlannerName

NAMES = get_args(PlannerName)
STILL = np.zeros(5)
CELLS = 30_000.0


def mission(name: PlannerName, drones: int = 2) -> Mission:
    starts = tuple(Drone(id=k + 1, start=(1.3 * k - 0.6, 1.0, 2.0, 0.0, 1.3)) for k in range(drones))
    return Mission(controller=Controller(planner=name), drones=starts)


@pytest.fixture(params=NAMES)
def name(request: pytest.FixtureRequest) -> PlannerName:
    chosen: PlannerName = request.param
    return chosen


@pytest.fixture
def planner(name: PlannerName) -> Planner:
    return make_planner(mission(name), 1)


def terms(rng: np.random.Generator) -> SamplingTerms:
    return SamplingTerms(rng.normal(size=5) * 300, float(rng.uniform(0, 40)), float(rng.uniform(0, 10)))


def situation(seed: int) -> tuple[Floats, Floats, list[Neighbour], SamplingTerms]:
    """Somewhere in the region, in flight, among some neighbours that are not too near."""
    rng = np.random.default_rng(seed)
    pose = rng.uniform([-3.9, -3.9, 0.6, -math.pi, 1.1], [3.9, 3.9, 4.9, math.pi, 1.55])
    neighbours = []
    for drone in range(2, 2 + int(rng.integers(1, 4))):
        direction = rng.normal(size=3)
        position = pose[:3] + direction / np.linalg.norm(direction) * rng.uniform(1.4, 3)
        neighbours.append(Neighbour(drone, position, 0.0))
    return pose, rng.uniform(-0.1, 0.1, 5), neighbours, terms(rng)


def test_velocities_keep_their_bounds_and_all_strict_rows(planner: Planner, name: PlannerName) -> None:
    barriers, flight = Barriers(mission(name)), mission(name).flight
    for seed in range(100):
        pose, velocity, neighbours, wanted = situation(seed)
        low, high = barriers.velocity_bounds(velocity)
        rows = barriers.rows(predicted_pose(pose, velocity, flight), neighbours)

        decision = planner.decide(pose, velocity, neighbours, wanted, CELLS)

        assert decision.outcome == "solved", seed
        assert (decision.velocity >= low).all(), seed
        assert (decision.velocity <= high).all(), seed
        assert (rows.coefficients @ decision.velocity >= rows.bounds).all(), seed
        assert decision.sampling == pytest.approx(3.0 * wanted.first)


def test_the_same_states_have_the_same_answers(name: PlannerName) -> None:
    def flown() -> tuple[str, list[bytes]]:
        flight = TeamFlight(mission(name))
        for _ in range(150):
            flight.step()
        return flight.replicas[0].sha256, [body.pose.tobytes() for body in flight.bodies]

    assert flown() == flown()


@pytest.mark.parametrize("outcome", [outcome for outcome in get_args(Outcome) if outcome != "solved"])
def test_any_outcome_but_solved_brakes_and_is_told(
    planner: Planner, outcome: Outcome, monkeypatch: pytest.MonkeyPatch
) -> None:
    failed = Solution(outcome, np.full(5, 0.3), 0.0, ())
    monkeypatch.setattr("agents.quadratic_program.QuadraticProgram.solve", lambda *_: failed)
    pose, velocity, neighbours, wanted = situation(1)

    decision = planner.decide(pose, velocity, neighbours, wanted, CELLS)

    assert decision.outcome == outcome
    assert not decision.velocity.any()


def test_a_drone_between_two_that_are_too_near_brakes(planner: Planner) -> None:
    pose = np.array([0.2, -0.3, 2.0, 0.0, 1.5])
    pinching = [Neighbour(k, pose[:3] + np.array([offset, 0.0, 0.0]), 0.0) for k, offset in ((2, 0.3), (3, -0.3))]

    decision = planner.decide(pose, STILL, pinching, terms(np.random.default_rng(0)), CELLS)

    assert decision.outcome == "infeasible"
    assert not decision.velocity.any()


def test_telemetry_that_is_no_number_brakes_and_harms_no_later_answer(planner: Planner) -> None:
    pose, velocity, neighbours, wanted = situation(2)
    lost = pose.copy()
    lost[0] = math.nan

    assert planner.decide(lost, velocity, neighbours, wanted, CELLS).outcome == "numerical"
    assert planner.decide(pose, velocity, neighbours, wanted, CELLS).outcome == "solved"


def test_a_drone_that_is_told_to_stay_stays_unless_somebody_is_too_near(planner: Planner) -> None:
    pose = np.array([0.2, -0.3, 2.0, 0.0, 1.4])

    alone = planner.steer(pose, STILL, [Neighbour(2, pose[:3] + np.array([2.0, 0.0, 0.0]), 0.0)])
    crowded = planner.steer(pose, STILL, [Neighbour(2, pose[:3] + np.array([0.9, 0.0, 0.0]), 0.0)])

    assert np.abs(alone.velocity).max() < 1e-3
    assert crowded.velocity[0] < 0


def test_a_team_that_starts_as_near_as_it_may_keeps_its_distance(name: PlannerName) -> None:
    flight = TeamFlight(
        Mission(
            controller=Controller(planner=name),
            drones=(
                Drone(id=1, start=(0.0, 0.0, 2.0, 0.0, 1.1)),
                Drone(id=2, start=(0.0, 0.0, 3.0, 1.0, 1.5)),
                Drone(id=3, start=(1.0, 0.1, 2.0, 2.0, 1.3)),
            ),
        )
    )
    for _ in range(600):
        flight.step()
    assert flight.min_separation >= 1.0
    assert flight.path_m > 5.0, "and does not stand still because of it"
    assert flight.outcomes.count("solved") > 0.99 * len(flight.outcomes)


def test_one_that_stands_in_the_way_for_ever_is_not_touched(name: PlannerName) -> None:
    flight = TeamFlight(mission(name), silent=frozenset({1}))
    for _ in range(300):
        flight.step()
    assert flight.min_separation >= 1.0


def test_baselines_keep_their_height_and_their_camera_where_they_promise_it(name: PlannerName) -> None:
    flight = TeamFlight(
        Mission(controller=Controller(planner=name), drones=(Drone(id=1, start=(0.3, 0.2, 1.2, 0.4, 1.06)),))
    )
    (body,) = flight.bodies
    tilts, heights = [], []
    for _ in range(1200):
        flight.step()
        heights.append(body.pose[2])
        tilts.append(body.pose[4])
    if name == "coverage":
        assert np.ptp(heights[200:]) > 0.1
    else:
        assert np.abs(np.array(heights[200:]) - 2.0).max() < 0.02
    if name in DOWNWARD:
        assert np.abs(np.array(tilts[200:]) - math.pi / 2).max() < 0.01
    else:
        assert np.ptp(tilts[200:]) > 0.1, "turns its camera"


def test_importance_falls_as_long_as_it_flies(name: PlannerName) -> None:
    flight, before = TeamFlight(mission(name)), 1.0
    for _ in range(5):
        for _ in range(200):
            flight.step()
        assert flight.importance < before - 0.01
        before = flight.importance


def test_a_rehearsal_needs_nothing_of_a_flight(name: PlannerName) -> None:
    compile_kernels()
    make_planner(mission(name, 1), 1).rehearse()
    make_planner(mission(name, 4), 3).rehearse()


def test_a_gimbal_that_does_not_quite_reach_down_is_turned_as_far_as_it_goes() -> None:
    for name in sorted(DOWNWARD):
        flight = TeamFlight(
            Mission(
                controller=Controller(planner=name),
                flight=Flight(pitch_limits_rad=(1.0, 1.56)),
                drones=(Drone(id=1, start=(0.3, 0.2, 2.0, 0.0, 1.1)),),
            )
        )
        for _ in range(300):
            flight.step()
        assert flight.bodies[0].pose[4] == pytest.approx(1.56, abs=0.01)
        assert flight.path_m > 0.5
