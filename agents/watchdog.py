"""Stops the vehicle when the control task falls silent, whatever the reason, and gives it up when that lasts.

It runs in a thread of its own, because what it guards against is an event loop that is blocked or a task that died;
an autopilot's own time-out does not help where its link layer keeps repeating the last setpoint.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable
from types import TracebackType
from typing import Self

from agents.silence import WitnessedSilence
from protocol.errors import CovreconError

log = logging.getLogger(__name__)

CHECKS_PER_TIMEOUT = 5


class Watchdog:
    """Calls ``stop`` once each time ``now`` runs ``timeout_s`` past the last `feed`, and ``give_up`` once each time the
    silence has lasted for ``give_up_after_s``.

    ``now`` gives seconds of monotonic time. In lockstep simulation that is the time of the vehicle's newest tick:
    while the simulator waits, nothing moves, and waiting is not silence. Nor is all of the time during which nothing
    ran here, the watchdog itself included (SIGSTOP, a suspended machine): the control task may be back as well, so
    between two checks at most ``timeout_s`` counts towards giving up.
    """

    def __init__(
        self,
        stop: Callable[[], None],
        now: Callable[[], float],
        timeout_s: float,
        *,
        give_up: Callable[[], None] | None = None,
        give_up_after_s: float = math.inf,
    ) -> None:
        """``give_up``: what leaves the vehicle to itself, holding or landing; called from the watchdog's thread."""
        self._stop, self._now, self._timeout_s = stop, now, timeout_s
        self._give_up, self._give_up_after_s = give_up, give_up_after_s
        self._fed_at: float | None = None
        self._stopped_at: float | None = None
        self._given_up_at: float | None = None
        self._silence = WitnessedSilence(timeout_s)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)
        self.stops = 0
        """How often the vehicle had to be stopped ..."""
        self.given_up = 0
        """... and to be given up."""

    def feed(self) -> None:
        """A setpoint was sent."""
        self._fed_at = self._now()

    def check(self) -> bool:
        """Stop the vehicle if it is overdue, give it up if it is so for long; True if either was done now. Silence
        before the first setpoint is not overdue.

        Raises:
            CovreconError: the vehicle could not be told; the next check tries again.
        """
        # `feed` writes its own field alone: a setpoint sent at this very moment is watched again.
        fed_at, now = self._fed_at, self._now()
        if fed_at is None:
            return False
        silence_s = self._silence.look(fed_at, now)
        try:
            stopped = self._stop_if_overdue(fed_at, now)
        finally:
            given_up = self._give_up_if_overdue(fed_at, silence_s)
        return stopped or given_up

    def _stop_if_overdue(self, fed_at: float, now: float) -> bool:
        if fed_at == self._stopped_at or now - fed_at <= self._timeout_s:
            return False
        self._stop()
        self._stopped_at = fed_at
        self.stops += 1
        log.error("no setpoint for %.2f s: vehicle stopped", self._timeout_s)
        return True

    def _give_up_if_overdue(self, fed_at: float, silence_s: float) -> bool:
        if self._give_up is None or fed_at == self._given_up_at or silence_s <= self._give_up_after_s:
            return False
        self._give_up()
        self._given_up_at = fed_at
        self.given_up += 1
        log.error("no setpoint for %.2f s: vehicle left to itself", self._give_up_after_s)
        return True

    def _watch(self) -> None:
        while not self._ended.wait(self._timeout_s / CHECKS_PER_TIMEOUT):
            try:
                self.check()
            except CovreconError:
                log.exception("the vehicle cannot be told; trying again")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join()
