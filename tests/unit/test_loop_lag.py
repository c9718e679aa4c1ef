"""A loop that comes late is seen to."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

import pytest
import uvloop

from protocol.loop_lag import PERIOD_S, SAMPLES, WINDOW_S, LoopLag


def test_nothing_known_is_no_lag() -> None:
    lag = LoopLag()

    assert (lag.p99_s, lag.max_s) == (0.0, 0.0)


def test_one_late_wake_up_in_a_hundred_is_the_largest_and_not_yet_the_99th_percentile() -> None:
    lag = LoopLag()
    for late_s in [0.001] * 99 + [0.019]:
        lag.record(late_s)

    assert (lag.p99_s, lag.max_s) == (0.001, 0.019)

    lag.record(0.018)
    assert lag.p99_s == 0.018


def test_a_standstill_counts_as_long_as_it_lasted() -> None:
    """A tenth of the window: a twentieth of all timers were late by half of it or more."""
    lag = LoopLag()
    for _ in range(SAMPLES):
        lag.record(0.0)

    lag.record(WINDOW_S / 10)

    assert lag.max_s == WINDOW_S / 10
    assert lag.p99_s == pytest.approx(0.9 * WINDOW_S / 10, abs=PERIOD_S)


def test_what_is_older_than_the_window_is_forgotten() -> None:
    lag = LoopLag()
    lag.record(0.5)
    for _ in range(SAMPLES):
        lag.record(0.001)

    assert lag.max_s == 0.001


def test_a_process_that_was_stopped_for_an_hour_does_not_fill_the_memory() -> None:
    lag = LoopLag()

    lag.record(3600.0)

    assert lag.max_s == 3600.0
    assert len(lag._lags_s) == SAMPLES


@pytest.mark.parametrize("factory", [asyncio.new_event_loop, uvloop.new_event_loop], ids=["asyncio", "uvloop"])
def test_a_callback_that_computes_too_long_is_seen(factory: Callable[[], asyncio.AbstractEventLoop]) -> None:
    busy_s = 0.1

    async def body() -> LoopLag:
        lag = LoopLag()
        watching = asyncio.create_task(lag.watch())
        await asyncio.sleep(0)  # its timer is set
        until = time.monotonic() + busy_s
        while time.monotonic() < until:
            pass
        async with asyncio.timeout(20 * busy_s):
            while not lag.max_s:  # noqa: ASYNC110 - a lag is looked at, it tells nobody
                await asyncio.sleep(0)
        watching.cancel()
        return lag

    with asyncio.Runner(loop_factory=factory) as runner:
        lag = runner.run(body())

    assert busy_s - 2 * PERIOD_S < lag.max_s < 20 * busy_s
