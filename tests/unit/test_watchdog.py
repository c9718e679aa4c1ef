"""A vehicle whose control task fell silent is stopped, and later given up, whatever the event loop does."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import pytest

from agents.watchdog import CHECKS_PER_TIMEOUT, Watchdog
from protocol.errors import BusError, CovreconError, VehicleError

TIMEOUT_S = 0.5
GIVE_UP_S = 3.0
QUICK_S = 0.02
"""Time-out of the tests with a real thread."""
PATIENCE_S = 20.0


@dataclass
class Bench:
    """A watchdog by a clock that is set by hand, and how often it stopped the vehicle and gave it up."""

    time_s: float = 100.0
    stops: int = 0
    surrenders: int = 0
    broken: bool = False
    unwilling: bool = False
    watchdog: Watchdog = field(init=False)

    def __post_init__(self) -> None:
        self.watchdog = Watchdog(
            self._stop, lambda: self.time_s, TIMEOUT_S, give_up=self._give_up, give_up_after_s=GIVE_UP_S
        )

    def _stop(self) -> None:
        if self.broken:
            raise BusError("no link")
        self.stops += 1

    def _give_up(self) -> None:
        if self.unwilling:
            raise VehicleError("command denied")
        self.surrenders += 1

    def check_after(self, seconds: float) -> bool:
        self.time_s += seconds
        return self.watchdog.check()

    def stay_silent(self, seconds: float) -> None:
        """As its thread lives through it: check by check."""
        until = self.time_s + seconds
        while self.time_s < until:
            with suppress(CovreconError):
                self.check_after(min(TIMEOUT_S / CHECKS_PER_TIMEOUT, until - self.time_s))


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


# --- and given up ----------------------------------------------------------------------------------------------------


def test_a_long_silence_gives_the_vehicle_up_once_after_it_was_stopped_once() -> None:
    bench = Bench()
    bench.watchdog.feed()

    bench.stay_silent(GIVE_UP_S - 0.01)
    assert (bench.stops, bench.surrenders) == (1, 0)
    bench.stay_silent(0.02)
    assert (bench.stops, bench.surrenders) == (1, 1)
    bench.stay_silent(10 * GIVE_UP_S)
    assert (bench.stops, bench.surrenders) == (1, 1)
    assert bench.watchdog.given_up == 1


def test_a_check_that_gives_the_vehicle_up_says_so() -> None:
    bench = Bench()
    bench.watchdog.feed()

    assert [bench.check_after(TIMEOUT_S) for _ in range(8)] == [False, True, *[False] * 4, True, False]


def test_the_next_silence_gives_it_up_again() -> None:
    bench = Bench()
    for _ in range(2):
        bench.watchdog.feed()
        bench.stay_silent(GIVE_UP_S + 0.1)

    assert bench.surrenders == bench.stops == 2


def test_setpoints_that_come_late_but_come_never_give_it_up() -> None:
    bench = Bench()
    for _ in range(10):
        bench.watchdog.feed()
        bench.stay_silent(GIVE_UP_S - 0.1)

    assert (bench.stops, bench.surrenders) == (10, 0)


def test_a_vehicle_that_cannot_be_stopped_is_given_up_all_the_same() -> None:
    bench = Bench(broken=True)
    bench.watchdog.feed()

    bench.stay_silent(GIVE_UP_S + 0.1)

    assert (bench.stops, bench.surrenders) == (0, 1)


def test_a_vehicle_that_refuses_to_be_given_up_is_told_again() -> None:
    bench = Bench(unwilling=True)
    bench.watchdog.feed()
    bench.stay_silent(GIVE_UP_S + 0.1)
    with pytest.raises(VehicleError):
        bench.check_after(0.1)
    assert (bench.stops, bench.watchdog.given_up) == (1, 0)

    bench.unwilling = False
    assert bench.check_after(0.1)
    assert bench.surrenders == 1


def test_a_process_that_was_stopped_for_long_stops_its_vehicle_but_may_have_it_back() -> None:
    bench = Bench()
    bench.watchdog.feed()
    bench.stay_silent(0.1)

    assert bench.check_after(100 * GIVE_UP_S)  # nothing ran in between, the watchdog neither
    assert (bench.stops, bench.surrenders) == (1, 0)
    bench.stay_silent(GIVE_UP_S - TIMEOUT_S - 0.2)
    assert bench.surrenders == 0
    bench.stay_silent(0.2)
    assert bench.surrenders == 1


def test_a_watchdog_that_seldom_gets_to_run_gives_the_vehicle_up_at_last() -> None:
    bench = Bench()
    bench.watchdog.feed()

    checks = [bench.check_after(4 * TIMEOUT_S) for _ in range(7)]

    assert checks == [True, *[False] * 5, True]


@pytest.mark.parametrize("half", [{"give_up": pytest.fail}, {"give_up_after_s": 1.0}])
def test_without_a_second_stage_a_silence_only_stops_the_vehicle(half: dict[str, Any]) -> None:
    time_s = 0.0
    watchdog = Watchdog(lambda: None, lambda: time_s, TIMEOUT_S, **half)
    watchdog.feed()

    for step in range(1, 1000):
        time_s = step * TIMEOUT_S
        watchdog.check()

    assert (watchdog.stops, watchdog.given_up) == (1, 0)


# --- its thread ------------------------------------------------------------------------------------------------------


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


async def test_a_blocked_event_loop_does_not_keep_the_vehicle_from_being_given_up() -> None:
    given_up = threading.Event()
    calls: list[str] = []
    refusals: Iterator[bool] = iter([True, False])

    def stop() -> None:
        calls.append("stop")
        raise BusError("no link")

    def give_up() -> None:
        calls.append(threading.current_thread().name)
        if next(refusals):
            raise VehicleError("command denied")
        given_up.set()

    with Watchdog(stop, time.monotonic, QUICK_S, give_up=give_up, give_up_after_s=5 * QUICK_S) as watchdog:
        watchdog.feed()
        assert given_up.wait(PATIENCE_S)
    assert calls[0] == "stop"
    assert calls.count("watchdog") == 2


def test_the_thread_ends_with_its_context_and_stops_nothing_any_more() -> None:
    bench = Bench()
    with bench.watchdog:
        bench.watchdog.feed()
    bench.time_s += 10 * TIMEOUT_S

    assert not bench.watchdog._thread.is_alive()
    assert bench.stops == 0
