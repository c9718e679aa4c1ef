"""A vehicle whose control task fell silent is stopped, whatever the event loop does."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import pytest

from agents.watchdog import Watchdog
from protocol.errors import BusError

TIMEOUT_S = 0.5
QUICK_S = 0.02
"""Time-out of the tests with a real thread."""
PATIENCE_S = 20.0


@dataclass
class Bench:
    """A watchdog by a clock that is set by hand, and how often it stopped the vehicle."""

    time_s: float = 100.0
    stops: int = 0
    broken: bool = False
    watchdog: Watchdog = field(init=False)

    def __post_init__(self) -> None:
        self.watchdog = Watchdog(self._stop, lambda: self.time_s, TIMEOUT_S)

    def _stop(self) -> None:
        if self.broken:
            raise BusError("no link")
        self.stops += 1

    def check_after(self, seconds: float) -> bool:
        self.time_s += seconds
        return self.watchdog.check()


def test_before_the_first_setpoint_nothing_is_overdue() -> None:
    bench = Bench()

    assert not bench.check_after(1e6)
    assert bench.stops == 0


def test_the_vehicle_is_stopped_once_setpoints_are_overdue_and_not_before() -> None:
    bench = Bench()
    bench.watchdog.feed()

    assert not bench.check_after(TIMEOUT_S)
    assert bench.check_after(1e-3)
    assert bench.stops == bench.watchdog.stops == 1


def test_each_setpoint_starts_the_time_anew() -> None:
    bench = Bench()
    for _ in range(10):
        bench.watchdog.feed()
        assert not bench.check_after(0.9 * TIMEOUT_S)
    assert bench.check_after(0.2 * TIMEOUT_S)


def test_one_silence_stops_the_vehicle_once_and_the_next_one_again() -> None:
    bench = Bench()
    bench.watchdog.feed()
    assert bench.check_after(2 * TIMEOUT_S)
    assert not bench.check_after(2 * TIMEOUT_S)

    bench.watchdog.feed()
    assert not bench.check_after(0.5 * TIMEOUT_S)
    assert bench.check_after(TIMEOUT_S)
    assert bench.stops == bench.watchdog.stops == 2


def test_a_clock_that_stands_still_is_not_silence() -> None:
    bench = Bench()
    bench.watchdog.feed()

    assert not any(bench.check_after(0.0) for _ in range(1000))


def test_a_vehicle_that_could_not_be_told_is_told_again() -> None:
    bench = Bench(broken=True)
    bench.watchdog.feed()
    for _ in range(2):
        with pytest.raises(BusError):
            bench.check_after(2 * TIMEOUT_S)
    assert bench.watchdog.stops == 0

    bench.broken = False
    assert bench.check_after(0.0)
    assert bench.stops == 1


def test_a_setpoint_sent_while_the_vehicle_is_being_stopped_is_watched() -> None:
    time_s = 0.0

    def stop() -> None:
        watchdog.feed()  # the event loop wakes up at this very moment, and falls silent again

    watchdog = Watchdog(stop, lambda: time_s, TIMEOUT_S)
    watchdog.feed()
    time_s = 1.0
    assert watchdog.check()
    time_s = 2.0
    assert watchdog.check()


async def test_a_blocked_event_loop_does_not_keep_the_vehicle_from_being_stopped() -> None:
    stopped = threading.Event()
    stopper: list[str] = []

    def stop() -> None:
        stopper.append(threading.current_thread().name)
        stopped.set()

    with Watchdog(stop, time.monotonic, QUICK_S) as watchdog:
        watchdog.feed()
        assert stopped.wait(PATIENCE_S), "this wait blocks the loop: no task of it could have stopped the vehicle"
    assert stopper == ["watchdog"]


def test_the_thread_goes_on_after_a_vehicle_could_not_be_told() -> None:
    told = threading.Event()
    failures: Iterator[bool] = iter([True, True, False])

    def stop() -> None:
        if next(failures):
            raise BusError("no link")
        told.set()

    with Watchdog(stop, time.monotonic, QUICK_S) as watchdog:
        watchdog.feed()
        assert told.wait(PATIENCE_S)


def test_the_thread_ends_with_its_context_and_stops_nothing_any_more() -> None:
    bench = Bench()
    with bench.watchdog:
        bench.watchdog.feed()
    bench.time_s += 10 * TIMEOUT_S

    assert not bench.watchdog._thread.is_alive()
    assert bench.stops == 0
