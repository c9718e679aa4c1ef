"""Rows from cells that are not free: exact, enough for as long as a velocity may be flown, never without an answer."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
import pytest

from agents.barriers import OBSTACLE, Barriers
from agents.obstacle_rows import nearest_distance
from agents.obstacles import Obstacles
from agents.planners.safety_filter import SafetyFilter
from agents.quadratic_program import QuadraticProgram, Solution
from faults.seen_room import not_free, room_mission, rough_map
from ground_station.console.constraints import all_in_words
from protocol.geometry import Floats
from protocol.messages import FreeCells
from protocol.mission import Mission
from protocol.obstacle_grid import kept_distance
from protocol.separation import top_speed

SEEDS = range(12)
TICK = 40


def told(mission: Mission, seed: int, share: float = 0.9) -> Obstacles:
    """That has heard of a rough map, and of nothing that the mission vouches for."""
    obstacles = Obstacles(mission)
    obstacles.grid.vouched[:] = False
    obstacles.hear(FreeCells(tick=TICK, packed=obstacles.grid.pack(rough_map(obstacles.grid, seed, share))))
    obstacles.advance(TICK)
    return obstacles


def safe_places(obstacles: Obstacles, mission: Mission, rng: np.random.Generator, count: int) -> list[Floats]:
    """Where the barrier is not negative, the nearest ones first."""
    places = rng.uniform(mission.flight.lower_m, mission.flight.upper_m, (400, 3))
    margins = [obstacles.margin(place, 3.0) for place in places]
    order = [k for k in np.argsort(margins) if margins[k] >= 0]
    return [places[k] for k in order[:count]]


def velocities(rng: np.random.Generator, speed: float, count: int) -> Floats:
    """(count, 3) up to top speed, a third of them at it."""
    directions = rng.normal(size=(count, 3))
    lengths = speed * np.minimum(1.0, rng.uniform(0.1, 1.5, count))
    moves: Floats = directions / np.linalg.norm(directions, axis=1, keepdims=True) * lengths[:, None]
    return moves


@pytest.mark.parametrize("seed", SEEDS)
def test_what_meets_the_rows_keeps_the_promise_of_the_barrier_as_long_as_it_may_be_flown(seed: int) -> None:
    mission = room_mission()
    obstacles, rng = told(mission, seed, share=0.995), np.random.default_rng(seed)
    gain, hold = mission.controller.separation_gain_per_s, mission.flight.setpoint_timeout_s
    kept, free, tried = kept_distance(mission.flight), obstacles.free, 0
    for place in safe_places(obstacles, mission, rng, 6):
        rows = obstacles.rows(place)
        before = not_free(obstacles.grid, free, place) - kept
        for velocity in velocities(rng, top_speed(mission.flight), 80):
            if (rows.normals @ velocity < rows.bounds).any():
                continue
            tried += 1
            for t in (mission.tick_s, hold / 2, hold):
                after = not_free(obstacles.grid, free, place + t * velocity) - kept
                assert after >= (1 - gain * t) * before - 1e-9
    assert tried > 50


@pytest.mark.parametrize("seed", SEEDS)
def test_standing_still_meets_all_rows_where_the_barrier_is_not_negative(seed: int) -> None:
    mission = room_mission()
    obstacles = told(mission, seed, share=0.997)
    places = safe_places(obstacles, mission, np.random.default_rng(seed), 60)
    assert len(places) == 60
    for place in places:
        rows = obstacles.rows(place)
        assert (rows.bounds <= 0).all()
        assert rows.barriers.min(initial=math.inf) >= 0


@pytest.mark.parametrize("seed", SEEDS)
def test_the_nearest_cell_is_found_as_one_by_one(seed: int) -> None:
    mission = room_mission()
    obstacles, rng = told(mission, seed), np.random.default_rng(seed)
    for place in rng.uniform([-2.5, -2.5, -0.5], [2.5, 2.5, 3.5], (40, 3)):
        one_by_one = not_free(obstacles.grid, obstacles.free, place)
        found = nearest_distance(place, obstacles.free, obstacles.grid.origin, obstacles.grid.cell_m, 0.8)
        assert found == pytest.approx(one_by_one if one_by_one <= 0.8 else math.inf)
        rows = obstacles.rows(place)
        if len(rows.bounds):
            assert rows.barriers.min() == pytest.approx(one_by_one - obstacles.kept_m)


def test_a_wall_of_many_cells_is_one_row() -> None:
    obstacles = Obstacles(room_mission())
    free = np.ones(obstacles.grid.shape, np.bool_)
    free[:, :, :5] = False
    obstacles.free = free
    top = obstacles.grid.origin[2] + 5 * obstacles.grid.cell_m

    rows = obstacles.rows(np.array([0.11, -0.23, top + 0.4]))

    assert rows.normals.tolist() == [[0.0, 0.0, 1.0]]
    assert rows.barriers[0] == pytest.approx(0.4 - obstacles.kept_m)
    assert rows.bounds[0] == pytest.approx(-rows.barriers[0])


@pytest.mark.parametrize("seed", SEEDS)
def test_the_program_has_an_answer_that_meets_the_rows_however_rough_the_map(seed: int) -> None:
    mission = room_mission()
    obstacles, rng = told(mission, seed, share=0.995), np.random.default_rng(seed)
    planner, barriers = SafetyFilter(mission, 1), Barriers(mission)
    planner.heed(obstacles)
    barriers.heed(obstacles)
    answers = 0
    for place in safe_places(obstacles, mission, rng, 20):
        pose = np.array([*place, 0.0, 1.3])
        decision = planner.steer(pose, np.zeros(5), [], np.array([*rng.normal(size=3), 0.0, 0.0]))
        rows = barriers.rows(pose, [])
        assert set(decision.rows.names) == set(rows.names)
        assert (rows.coefficients @ decision.velocity >= rows.bounds - 1e-9).all()
        answers += decision.outcome == "solved"
    assert answers >= 18, "a drone held on all sides brakes, which is the answer there"


@pytest.mark.parametrize(("seed", "count"), [(10, 37), (33, 37), (36, 29), (39, 46)])
def test_a_program_that_the_solver_gives_up_is_asked_once_more_within_the_same_rows(
    seed: int, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Random pulls beside rough maps; in each of these series the solver gives up at least once."""
    mission = room_mission()
    obstacles, rng = Obstacles(mission), np.random.default_rng(seed)
    obstacles.free = rough_map(obstacles.grid, seed, 0.98) | obstacles.grid.vouched
    planner = SafetyFilter(mission, 0)
    planner.heed(obstacles)
    outcomes: list[str] = []
    solve = QuadraticProgram.solve

    def noted(program: QuadraticProgram, *asked: Any) -> Solution:
        found = solve(program, *asked)
        outcomes.append(found.outcome)
        return found

    monkeypatch.setattr(QuadraticProgram, "solve", noted)
    given_up = 0
    for _ in range(count):
        pose = np.array([*rng.uniform(mission.flight.lower_m, mission.flight.upper_m), 0.0, 1.3])
        xi1 = rng.normal(size=5) * rng.choice([1.0, 10.0, 100.0, 1000.0], size=5)
        outcomes.clear()
        decision = planner.solve(pose, np.zeros(5), [], xi1, -0.5 * rng.uniform(0.2, 1.5) * np.abs(xi1).sum())
        if outcomes[0] in ("out_of_time", "numerical"):
            given_up += 1
            assert decision.outcome == outcomes[1] == "solved"
            assert (decision.rows.coefficients @ decision.velocity >= decision.rows.bounds - 1e-9).all()
        else:
            assert len(outcomes) == 1
    assert given_up


@pytest.mark.parametrize("seed", SEEDS)
def test_braking_where_a_map_has_learned_of_something_worsens_nothing_and_leaves_it(seed: int) -> None:
    mission = room_mission()
    obstacles, rng = told(mission, seed, share=0.99), np.random.default_rng(seed)
    planner, barriers = SafetyFilter(mission, 0), Barriers(mission)
    planner.heed(obstacles)
    barriers.heed(obstacles)
    low, high = barriers.velocity_bounds(np.zeros(5))
    inside = left = 0
    for place in rng.uniform(mission.flight.lower_m, mission.flight.upper_m, (200, 3)):
        rows = barriers.rows(np.array([*place, 0.0, 1.3]), [])
        velocity = planner.brake(rows, low, high)
        assert (rows.coefficients @ velocity >= np.minimum(rows.bounds, 0.0) - 1e-9).all()
        if rows.margin(OBSTACLE, 0.0) < 0:
            inside += 1
            left += bool(velocity.any())
        else:
            assert not velocity.any()
    assert inside > 10
    assert left > 0.5 * inside, "amid many cells all ways out of some lead into others"


@pytest.mark.parametrize("width", [4, 5, 6])
def test_a_drone_in_a_gap_that_turned_out_too_narrow_leaves_it_upwards(width: int) -> None:
    """Wider than the drone and narrower than its margins: no velocity meets both sides' rows."""
    mission = room_mission()
    obstacles, planner = Obstacles(mission), SafetyFilter(mission, 0)
    planner.heed(obstacles)
    grid = obstacles.grid
    free = np.zeros(grid.shape, np.bool_)
    free[20 : 20 + width] = True
    free[:, :, 10:] = True
    obstacles.free = free
    pose = np.array([*(grid.origin + grid.cell_m * np.array([20.2 + width / 2, 20.0, 7.0])), 0.0, 1.3])
    assert width * grid.cell_m < 2 * obstacles.kept_m

    outcomes, sides = set(), []
    for _ in range(200):
        decision = planner.steer(pose, np.zeros(5), [])
        outcomes.add(decision.outcome)
        sides.append(obstacles.margin(pose[:3], 3.0))
        pose = pose + mission.tick_s * decision.velocity

    assert "infeasible" in outcomes
    assert min(sides) >= sides[0] - 1e-6, "and it never comes nearer to anything"
    assert obstacles.margin(pose[:3], 3.0) >= -1e-3


def test_a_drone_where_something_was_seen_after_all_leaves_upwards() -> None:
    mission = room_mission()
    obstacles, planner = Obstacles(mission), SafetyFilter(mission, 0)
    planner.heed(obstacles)
    free = np.ones(obstacles.grid.shape, np.bool_)
    free[18:23, 18:23, :8] = False
    obstacles.free = free
    place = obstacles.grid.origin + obstacles.grid.cell_m * np.array([20.5, 20.5, 6.5])

    decision = planner.steer(np.array([*place, 0.0, 1.3]), np.zeros(5), [])

    assert decision.velocity[2] > 0.2
    assert np.abs(decision.velocity[:2]).max() < 1e-3


def test_an_unsure_position_keeps_farther_away() -> None:
    obstacles = Obstacles(room_mission())
    sure = obstacles.kept_m
    obstacles.advance(0, 0.1)
    assert obstacles.kept_m == pytest.approx(sure + 0.3, abs=0.03)


def test_a_map_takes_effect_at_its_tick_and_one_of_another_room_never() -> None:
    obstacles = Obstacles(room_mission())
    grid = obstacles.grid
    for tick, free in ((20, np.zeros(grid.shape, np.bool_)), (30, np.ones(grid.shape, np.bool_))):
        obstacles.hear(FreeCells(tick=tick, packed=grid.pack(free)))
    assert obstacles.is_ready(39)
    assert not obstacles.is_ready(40), "one is due every ten ticks"

    late = Obstacles(room_mission())
    assert late.is_ready(35), "what was told before it joined never comes to it"
    assert not late.is_ready(40)

    obstacles.advance(29)
    assert np.array_equal(obstacles.free, grid.vouched)
    obstacles.advance(30)
    assert obstacles.free.all()
    obstacles.hear(FreeCells(tick=31, packed=b"rubbish"))
    obstacles.advance(31)
    assert obstacles.free.all()
    assert obstacles.refused == 1


def test_rows_take_little_of_a_tick() -> None:
    mission = room_mission()
    obstacles = told(mission, 1, share=0.97)
    places = np.random.default_rng(1).uniform(mission.flight.lower_m, mission.flight.upper_m, (50, 3))
    obstacles.rows(places[0])
    spent = []
    for _ in range(5):
        began_s = time.thread_time()
        for place in places:
            obstacles.rows(place)
        spent.append((time.thread_time() - began_s) / len(places))
    assert min(spent) < 0.3e-3


def test_the_console_has_words_for_a_row() -> None:
    assert "obstacle" in all_in_words([f"{OBSTACLE}:3"])
