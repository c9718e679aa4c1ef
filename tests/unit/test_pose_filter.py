"""The filter behind a lidar's poses: how far it says it may be off, what it believes, and what comes late."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.localization.pose_filter import (
    KEPT_TICKS,
    VELOCITY_WHITE_MPS,
    PoseFilter,
    largest_deviation,
)
from protocol.geometry import Floats

TICK_S = 0.05
START = np.array([1.0, -2.0, 1.5, 0.3])
GOOD = np.diag([0.01**2] * 3 + [0.003**2])
FORWARD = np.array([0.4, 0.0, 0.0, 0.1])


def started(velocity_sd_mps: float = 0.05) -> PoseFilter:
    return PoseFilter(0, START, 0.01, 0.003, velocity_sd_mps)


def advance(located: PoseFilter, ticks: int, velocity: Floats = FORWARD) -> None:
    for _ in range(ticks):
        located.advance(located.tick + 1, velocity, TICK_S)


def deviation(located: PoseFilter) -> float:
    return largest_deviation(located.covariance[:3, :3])


def test_velocity_carries_the_pose_and_yaw_wraps() -> None:
    located = started()
    advance(located, 20)
    assert located.pose == pytest.approx([1.4, -2.0, 1.5, 0.4])
    advance(located, 600)
    assert located.pose[3] == pytest.approx(math.remainder(0.3 + 31 * 0.1, math.tau))


def test_without_corrections_the_deviation_grows_with_the_time_as_a_slow_error_s_does() -> None:
    located = started()
    grown = []
    for _ in range(3):
        advance(located, 40)
        grown.append(deviation(located))
    assert grown[0] == pytest.approx(0.05 * 2.0, rel=0.1)
    assert grown[2] - grown[1] == pytest.approx(grown[1] - grown[0], rel=0.15)


def test_a_vehicle_without_a_slow_error_is_lost_with_the_root_of_the_time() -> None:
    located = started(velocity_sd_mps=0.0)
    advance(located, 400)
    assert deviation(located) == pytest.approx(math.hypot(0.01, VELOCITY_WHITE_MPS * TICK_S * math.sqrt(400)), rel=1e-3)


def test_corrections_bound_the_deviation_and_find_the_slow_error_of_the_velocity() -> None:
    located, true, wrong = started(), START.copy(), np.array([0.05, -0.03, 0.02, 0.0])
    for tick in range(1, 401):
        true += TICK_S * FORWARD
        located.advance(tick, FORWARD + wrong, TICK_S)
        if tick % 2 == 0:
            assert located.correct(tick, true, GOOD)
    assert located.pose == pytest.approx(true, abs=0.003)
    assert deviation(located) < 0.01
    assert located.velocity_error == pytest.approx(wrong[:3], abs=0.01)


def test_a_correction_that_comes_late_has_the_effect_of_one_that_came_in_time() -> None:
    early, late = started(), started()
    pose = START + 2 * TICK_S * FORWARD + np.array([0.01, 0.0, -0.01, 0.002])
    advance(early, 2)
    assert early.correct(2, pose, GOOD)
    advance(early, 3)
    advance(late, 5)
    assert late.correct(2, pose, GOOD)
    assert np.array_equal(early.pose, late.pose)
    assert np.array_equal(early.covariance, late.covariance)


@pytest.mark.parametrize("off", [(0.3, 0, 0, 0), (0, 0, -0.3, 0), (0, 0, 0, 0.2), (math.nan, 0, 0, 0)])
def test_a_pose_that_the_velocity_rules_out_is_refused_and_changes_nothing(off: tuple[float, ...]) -> None:
    located = started()
    advance(located, 2)
    before = located.pose, located.covariance
    assert not located.correct(2, located.pose + off, GOOD)
    assert np.array_equal(located.pose, before[0])
    assert np.array_equal(located.covariance, before[1])


def test_after_a_long_pause_the_same_pose_is_believed() -> None:
    located = started()
    advance(located, 80)
    assert located.correct(80, located.pose + np.array([0.3, 0, 0, 0]), GOOD)


def test_a_direction_that_a_correction_knows_nothing_of_stays_as_it_was() -> None:
    """Over a bare floor a scan knows height alone."""
    located = started()
    advance(located, 40)
    before = located.covariance
    assert located.correct(40, located.pose + np.array([5.0, 5.0, 0.01, 0.0]), np.diag([100.0, 100.0, 1e-4, 1e-4]))
    assert located.covariance[0, 0] == pytest.approx(before[0, 0], rel=1e-3)
    assert located.covariance[2, 2] < 0.1 * before[2, 2]


def test_what_is_about_a_forgotten_tick_or_one_that_was_passed_over_is_refused() -> None:
    located = started()
    located.advance(3, FORWARD, 3 * TICK_S)
    assert not located.correct(2, located.pose, GOOD)
    assert located.at(2) is None
    advance(located, KEPT_TICKS)
    assert not located.correct(3, located.pose, GOOD)


def test_an_older_tick_does_not_move_it_back() -> None:
    located = started()
    advance(located, 5)
    before = located.pose
    located.advance(4, FORWARD, TICK_S)
    assert located.tick == 5
    assert np.array_equal(located.pose, before)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), every=st.integers(1, 12))
def test_covariances_stay_symmetric_and_positive(seed: int, every: int) -> None:
    dice, located = np.random.default_rng(seed), started()
    for tick in range(1, 200):
        located.advance(tick, dice.normal(0, 0.5, 4), TICK_S)
        if tick % every == 0:
            spread = dice.normal(0, 0.05, (4, 4))
            located.correct(tick, located.pose + dice.normal(0, 0.01, 4), spread @ spread.T + 1e-6 * np.eye(4))
    assert located.covariance == pytest.approx(located.covariance.T)
    assert np.linalg.eigvalsh(located.covariance)[0] > 0


def test_errors_lie_within_what_is_told() -> None:
    """Of 300 flights whose velocity is off as expected, with corrections as good as they say: 99.7 % within 3 sigma."""
    beyond, flights = 0, 300
    for seed in range(flights):
        dice = np.random.default_rng(seed)
        located, true, wrong = started(), START.copy(), dice.normal(0, 0.05, 3)
        true[:3] += dice.normal(0, 0.01, 3)
        for tick in range(1, 41):
            true += TICK_S * FORWARD
            told = FORWARD.copy()
            told[:3] += wrong + dice.normal(0, VELOCITY_WHITE_MPS, 3)
            located.advance(tick, told, TICK_S)
            if tick % 10 == 0:
                located.correct(tick, true + dice.normal(0, 1, 4) * np.sqrt(np.diag(GOOD)), GOOD)
        error = (located.pose - true)[:3]
        beyond += error @ np.linalg.solve(located.covariance[:3, :3], error) > 14.16  # chi-squared, 3 degrees: 99.7 %
    assert beyond <= 5


def test_one_that_began_at_an_earlier_tick_was_carried_by_the_same_velocities() -> None:
    located = started()
    advance(located, 10)
    advance(located, 10, np.array([0.0, 0.5, 0.0, 0.0]))
    fresh = located.anew(4, np.zeros(4), 0.01, 0.01)
    assert fresh is not None
    assert fresh.tick == located.tick
    assert fresh.pose == pytest.approx([6 * TICK_S * 0.4, 10 * TICK_S * 0.5, 0.0, 6 * TICK_S * 0.1])
    assert located.anew(99, np.zeros(4), 0.01, 0.01) is None
