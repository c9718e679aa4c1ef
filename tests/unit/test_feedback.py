"""The J gate, the gain, and when."""

from __future__ import annotations

import numpy as np
import pytest

from ground_station.feedback import FeedbackSchedule
from protocol.map_settings import Feedback

CHANGE = np.array([0.0, 0.25, 1.0], np.float32)


def schedule(**settings: object) -> FeedbackSchedule:
    return FeedbackSchedule(Feedback.model_validate(settings), tick_s=0.05)


@pytest.mark.parametrize("importance", [0.5, 0.5000001, 1.0, 1.7])
def test_phi_does_not_jump_while_importance_is_at_or_above_the_threshold(importance: float) -> None:
    assert schedule(threshold=0.5).increments(CHANGE, importance) is None


@pytest.mark.parametrize("importance", [0.0, 0.3, 0.4999999])
def test_phi_jumps_by_the_gain_times_the_change_below_the_threshold(importance: float) -> None:
    increments = schedule(threshold=0.5, gain=0.5).increments(CHANGE, importance)

    assert increments is not None
    assert increments.dtype == np.float32
    assert increments.tolist() == [0.0, 0.125, 0.5]


def test_a_map_that_did_not_change_gives_no_jump() -> None:
    assert schedule().increments(np.zeros(3, np.float32), 0.1) is None


def test_without_gain_or_method_there_is_no_jump() -> None:
    assert schedule(gain=0.0).increments(CHANGE, 0.1) is None
    assert schedule(method="none").increments(CHANGE, 0.1) is None
    assert schedule().increments(CHANGE, 0.1) is not None


def test_maps_are_compared_once_a_period_from_the_first_full_one_on() -> None:
    timed = schedule(period_s=2.0)

    assert [tick for tick in range(161) if timed.is_due(tick)] == [40, 80, 120, 160]


def test_a_jump_takes_effect_a_delay_after_the_tick_of_its_map() -> None:
    assert schedule(delay_s=1.0).effective_tick(40) == 60


def test_a_jump_is_never_due_at_the_tick_of_its_own_map() -> None:
    assert schedule(delay_s=0.0).effective_tick(40) == 41


def test_a_period_shorter_than_a_tick_means_every_tick() -> None:
    eager = schedule(period_s=0.01, delay_s=0.0)

    assert [eager.is_due(tick) for tick in range(3)] == [False, True, True]


@pytest.mark.parametrize(("period_s", "delay_s"), [(2.0, 1.0), (2.0, 2.0), (0.05, 0.0), (0.5, 0.3)])
def test_a_tick_is_settled_exactly_when_no_later_map_can_change_it(period_s: float, delay_s: float) -> None:
    timed = schedule(period_s=period_s, delay_s=delay_s)

    for now in range(100):
        later = min(timed.effective_tick(tick) for tick in range(now + 1, now + 100) if timed.is_due(tick))
        assert timed.settled_after(now) == later - 1
