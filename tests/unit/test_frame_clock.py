"""Frames are stamped by when they would have come had nothing held them up."""

from __future__ import annotations

import numpy as np
import pytest

from agents.cameras.frame_clock import BEATEN_S, SETTLED_S, FrameClock

PERIOD_S = 0.04
OURS_S = 1000.0
"""What our clock shows when the camera's shows 0."""


def settled() -> tuple[FrameClock, int]:
    """One that has seen frames 0 to n - 1 without delay, and n."""
    clock, n = FrameClock(), round(2 * SETTLED_S / PERIOD_S)
    for k in range(n):
        clock.stamp(k * PERIOD_S, OURS_S + k * PERIOD_S)
    return clock, n


def test_frames_that_come_at_once_are_stamped_so_after_half_a_second() -> None:
    clock = FrameClock()

    stamps = [clock.stamp(k * PERIOD_S, OURS_S + k * PERIOD_S) for k in range(30)]

    first = round(SETTLED_S / PERIOD_S)
    assert stamps[:first] == [None] * first
    assert stamps[first + 1 :] == pytest.approx([OURS_S + k * PERIOD_S for k in range(first + 1, 30)])


def test_frames_that_waited_while_the_stream_was_opened_are_not_stamped() -> None:
    clock = FrameClock()
    opened_s = OURS_S + 20 * PERIOD_S

    stamps = [clock.stamp(k * PERIOD_S, max(opened_s + 0.001 * k, OURS_S + k * PERIOD_S)) for k in range(60)]

    came = [k for k, stamp in enumerate(stamps) if stamp is not None]
    assert came == list(range(came[0], 60))
    assert (came[0] - 20) * PERIOD_S >= SETTLED_S - PERIOD_S
    assert [stamps[k] for k in came] == pytest.approx([OURS_S + k * PERIOD_S for k in came], abs=0.002)


def test_frames_that_a_stall_held_up_are_stamped_as_if_it_had_not() -> None:
    clock, n = settled()
    stalled_until_s = OURS_S + (n + 20) * PERIOD_S

    stamps = [clock.stamp(k * PERIOD_S, max(stalled_until_s, OURS_S + k * PERIOD_S)) for k in range(n, n + 40)]

    assert stamps == pytest.approx([OURS_S + k * PERIOD_S for k in range(n, n + 40)], abs=BEATEN_S)


def test_frames_that_are_lost_do_not_unsettle_it() -> None:
    clock, n = settled()

    assert clock.stamp((n + 1000) * PERIOD_S, OURS_S + (n + 1000) * PERIOD_S) is not None


@pytest.mark.parametrize("drift", [-1e-4, 1e-4])
def test_a_camera_clock_that_runs_fast_or_slow_is_followed(drift: float) -> None:
    clock, n = settled()
    for k in range(n, 20 * 60 * 25):
        arrival_s = OURS_S + k * PERIOD_S
        stamp = clock.stamp(k * PERIOD_S * (1 + drift), arrival_s)
        assert stamp == pytest.approx(arrival_s, abs=0.002)


def test_a_camera_that_counts_frames_instead_of_time_is_followed_when_it_drops_one() -> None:
    clock, n = settled()

    stamps = {k: clock.stamp(k * PERIOD_S, OURS_S + (k + 1) * PERIOD_S) for k in range(n, n + 600)}

    assert stamps[n + 599] == pytest.approx(OURS_S + (n + 600) * PERIOD_S, abs=0.002)


def test_most_of_the_jitter_is_taken_away() -> None:
    clock, n = settled()
    late_s = np.random.default_rng(3).uniform(0.0, 0.03, 500)

    stamps = [clock.stamp(k * PERIOD_S, OURS_S + k * PERIOD_S + late_s[k - n]) for k in range(n, n + 500)]

    wished = np.array([OURS_S + k * PERIOD_S for k in range(n, n + 500)])
    assert np.abs(np.array(stamps, dtype=float) - wished).mean() < 0.2 * late_s.mean()


def test_a_camera_that_began_anew_is_watched_anew() -> None:
    clock, _ = settled()

    stamps = [clock.stamp(k * PERIOD_S, 2 * OURS_S + k * PERIOD_S) for k in range(30)]

    assert stamps[0] is None
    assert stamps[-1] == pytest.approx(2 * OURS_S + 29 * PERIOD_S)


def test_a_camera_without_stamps_is_never_trusted() -> None:
    clock = FrameClock()

    assert all(clock.stamp(0.0, OURS_S + k * PERIOD_S) is None for k in range(100))
