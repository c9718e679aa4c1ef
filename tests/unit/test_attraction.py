"""What the console says of a drone's motives against what the controller computes."""

from typing import get_args

import numpy as np
import pytest

from ground_station.console.attraction import attraction
from ground_station.console.explanation import Explanation, explain
from protocol.field import VirtualField
from protocol.importance import ImportanceField
from protocol.messages import Control, DroneState, Mode, ReplicaState
from protocol.mission import Sensing, Target
from protocol.planner_settings import FREE_AXES, PlannerName

SENSING = Sensing()
REPLICA = ReplicaState(tick=0, epoch=1, next_jump=0, missing=0, repaired=0, lost=0)
CONTROL = Control(
    tick=9,
    outcome="solved",
    velocity=(0.3, 0.0, -0.4, 0.2, -0.1),
    slack=-12.3,
    sampling=1.0,
    solve_s=0.001,
    separation_margin_m2=0.34,
    region_margin_m=1.2,
    pitch_margin_rad2=0.05,
    active=("separation:2", "bound:x"),
    fallbacks=0,
    refused=0,
)


def team(drones: int, seed: int) -> np.ndarray:
    """Poses so near each other that many cells are contested."""
    rng = np.random.default_rng(seed)
    return np.array([0.3, -0.2, 1.6, 0.4, 1.3]) + rng.uniform(-0.6, 0.6, (drones, 5)) * [1, 1, 0.5, 1, 0.3]


def state(drone: int, pose: np.ndarray, mode: Mode = "flying", control: Control | None = CONTROL) -> DroneState:
    x, y, z, yaw, pitch = pose.tolist()
    return DroneState(
        drone=drone,
        tick=10,
        pose=(x, y, z, yaw, pitch),
        velocity=(0.3, 0.0, -0.4, 0.2, -0.1),
        battery=0.9,
        mode=mode,
        importance=0.5,
        replica=REPLICA,
        control=control,
    )


def field(seed: int = 4) -> ImportanceField:
    importance = ImportanceField(VirtualField.of(Target(cell_m=0.2)), SENSING)
    importance.phi[:] = np.random.default_rng(seed).uniform(0, 1.5, importance.phi.shape)
    return importance


def island(place: tuple[float, float, float], radius_m: float = 0.15) -> ImportanceField:
    """Importance around one place alone."""
    importance = field()
    far = np.linalg.norm(importance.field.positions() - place, axis=1) > radius_m
    importance.phi[far] = 0
    importance.phi[~far] = 0.8
    return importance


@pytest.mark.parametrize("drones", [1, 2, 5])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_all_parts_together_are_the_gradient_that_the_controller_gets(drones: int, seed: int) -> None:
    importance, poses = field(seed), team(drones, seed)
    for own in range(drones):
        exact = importance.terms(poses, own).gradient
        cells = attraction(importance.field, importance.phi, SENSING, poses, own)
        assert len(cells.rows) > 20
        np.testing.assert_allclose(cells.gradients.sum(axis=0), exact, rtol=1e-4, atol=1e-4 * np.abs(exact).max())


def test_a_tie_is_the_lower_ids_alone() -> None:
    importance, pose = field(), team(1, 1)
    twins = np.repeat(pose, 2, axis=0)
    first = attraction(importance.field, importance.phi, SENSING, twins, 0)
    second = attraction(importance.field, importance.phi, SENSING, twins, 1)
    alone = attraction(importance.field, importance.phi, SENSING, pose, 0)
    np.testing.assert_array_equal(first.gradients, alone.gradients)
    assert len(second.rows) == 0


def told(
    importance: ImportanceField,
    states: dict[int, DroneState],
    drone: int = 1,
    count: int = 5,
    planner: PlannerName = "coverage",
) -> Explanation:
    return explain(importance, SENSING, states, drone, planner, count)


def test_the_only_important_place_is_named_with_all_of_the_pull() -> None:
    pose = np.array([0.0, 0.0, 1.8, 0.0, 1.4])
    found = told(island((0.7, 0.1, 0.9)), {1: state(1, pose)})
    assert len(found.pulls) == 1
    (pull,) = found.pulls
    np.testing.assert_allclose(pull.position, (0.7, 0.1, 0.9), atol=0.15)
    assert pull.importance == pytest.approx(0.8, abs=1e-6)
    assert pull.vector[0] > 0
    assert pull.share == pytest.approx(1.0)


def test_shares_fall_and_are_all_of_the_pull_together() -> None:
    found = told(field(), {1: state(1, team(1, 5)[0])}, count=1000)
    shares = [pull.share for pull in found.pulls]
    assert shares == sorted(shares, reverse=True)
    assert sum(shares) == pytest.approx(1.0)
    assert min(shares) > 0
    assert 0 <= found.opposed < 1
    assert told(field(), {1: state(1, team(1, 5)[0])}, count=3).pulls == found.pulls[:3]


def test_xi1_is_the_gradient_times_the_decay_with_the_team_in_the_order_of_ids() -> None:
    importance, poses = field(), team(3, 7)
    states = {7: state(7, poses[2]), 2: state(2, poses[0]), 4: state(4, poses[1])}
    exact = SENSING.decay_per_s * importance.terms(poses, 1).gradient
    np.testing.assert_allclose(told(importance, states, 4).xi1, exact, rtol=1e-4, atol=1e-4 * np.abs(exact).max())


def test_the_words_say_motion_places_and_limits() -> None:
    pose = np.array([0.0, 0.0, 1.8, 0.0, 1.4])
    lines = told(island((0.7, 0.1, 0.9)), {1: state(1, pose)}).lines
    assert lines[0] == (
        "flying: moves 0.50 m/s along (+0.60, +0.00, -0.80), turns left 0.20 rad/s, tilts its camera up 0.10 rad/s"
    )
    assert lines[1].startswith("100% of the pull: (0.7, 0.1, ")
    assert lines[1].endswith("importance 0.80")
    assert lines[3] == "limits: distance to drone 2, speed limit along x"
    assert lines[4] == "margins: separation 0.34 m², region 1.20 m, gimbal 0.050 rad²"
    assert lines[5] == "slack -12.3: its share cannot be covered as fast as wished"


def test_a_lone_drones_words_have_no_distance_to_others() -> None:
    lone = CONTROL.model_copy(update={"separation_margin_m2": 1e9, "active": ()})
    lines = told(field(), {1: state(1, team(1, 1)[0], control=lone)}).lines
    assert "limits: none in the way" in lines
    assert "margins: region 1.20 m, gimbal 0.050 rad²" in lines
    among = lone.model_copy(update={"obstacle_margin_m": 0.25})
    lines = told(field(), {1: state(1, team(1, 1)[0], control=among)}).lines
    assert "margins: region 1.20 m, obstacles 0.25 m, gimbal 0.050 rad²" in lines


def test_a_drone_without_importance_in_reach_says_so() -> None:
    importance = field()
    importance.phi[:] = 0
    found = told(importance, {1: state(1, team(1, 1)[0], control=None)})
    assert (found.pulls, found.opposed, found.xi1) == ((), 0.0, (0.0,) * 5)
    assert found.lines[1:] == ("nothing in its reach is of importance", "has not decided anything yet")


def test_a_drone_that_holds_is_said_not_to_be_steered_by_importance() -> None:
    lines = told(field(), {1: state(1, team(1, 1)[0], mode="holding")}).lines
    assert "importance does not steer it now" in lines[1]


def test_a_solver_that_failed_is_named() -> None:
    late = CONTROL.model_copy(update={"outcome": "out_of_time"})
    lines = told(field(), {1: state(1, team(1, 1)[0], mode="braking", control=late)}).lines
    assert "solver: out of time, so it brakes" in lines


@pytest.mark.parametrize("planner", [planner for planner in get_args(PlannerName) if planner != "coverage"])
def test_another_planner_is_named_and_nothing_is_told_that_does_not_move_it(planner: PlannerName) -> None:
    importance, states = field(), {1: state(1, team(1, 5)[0])}
    papers, found = told(importance, states), told(importance, states, planner=planner)

    assert found.lines[1].startswith(f"planner {planner.replace('_', ' ')}: ")
    free = np.array(FREE_AXES[planner])
    np.testing.assert_array_equal(found.xi1, np.where(free, papers.xi1, 0.0))
    assert bool(found.pulls) == free.any()
    assert all(pull.vector[2] == 0 for pull in found.pulls), "nobody feels a pull along z at one height"
    assert any("of the pull" in line for line in found.lines) == free.any()


def test_the_papers_controller_needs_no_introduction() -> None:
    assert not any(line.startswith("planner") for line in told(field(), {1: state(1, team(1, 5)[0])}).lines)


def test_a_lawnmower_that_holds_is_said_not_to_be_steered_by_its_planner() -> None:
    lines = told(field(), {1: state(1, team(1, 1)[0], mode="holding")}, planner="lawnmower").lines
    assert "holding: its planner does not steer it now" in lines
