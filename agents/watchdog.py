"""Stops the vehicle when the control task falls silent, whatever the reason.

It runs in a thread of its own, because what it guards against is an event loop that is blocked or a task that died;
an autopilot's own time-out does not help where its link layer keeps repeating the last setpoint.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from types import TracebackType
from typing import Self

from protocol.errors import CovreconError

log = logging.getLogger(__name__)

CHECKS_PER_TIMEOUT = 5


class Watchdog:
    """Calls ``stop`` once each time ``now`` runs ``timeout_s`` past the last `feed`.

    ``now`` gives seconds of monotonic time. In lockstep simulation that is the time of the vehicle's newest tick:
    while the simulator waits, nothing moves, and waiting is not silence.
    """

    def __init__(self, stop: Callable[[], None], now: Callable[[], float], timeout_s: float) -> None:
        self._stop, self._now, self._timeout_s = stop, now, timeout_s
        self._fed_at: float | None = None
        self._stopped_at: float | None = None
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)
        self.stops = 0
        """How often the vehicle had to be stopped."""

    def feed(self) -> None:
        """A setpoint was sent."""
        self._fed_at = self._now()

    def check(self) -> bool:
        """Stop the vehicle if it is overdue; True if so. Silence before the first setpoint is not overdue.

        Raises:
            CovreconError: the vehicle could not be told; the next check tries again.
        """
        fed_at = self._fed_at
        if fed_at is None or fed_at == self._stopped_at or self._now() - fed_at <= self._timeout_s:
            return False
        self._stop()
        # `feed` writes its own field alone: a setpoint sent at this very moment is watched again.
        self._stopped_at = fed_at
        self.stops += 1
        log.error("no setpoint for %.2f s: vehicle stopped", self._timeout_s)
        return True

    def _watch(self) -> None:
        while not self._ended.wait(self._timeout_s / CHECKS_PER_TIMEOUT):
            try:
                self.check()
            except CovreconError:
                log.exception("the vehicle cannot be stopped; trying again")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join()
