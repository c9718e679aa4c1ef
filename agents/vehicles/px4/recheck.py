"""The checks before another take-off: a vehicle that has landed may have been without power meanwhile.

Then its local frame is another one, nobody controls its gimbal, and its messages come at PX4's own rates. So all that
was prepared is prepared again: as soon as it fell silent on the ground, and before every further flight.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from concurrent.futures import Executor

from agents.vehicles.px4.preflight import Item
from agents.vehicles.px4.preparation import Preparation, Prepared, prepare_vehicle

FRESH_S = 10.0
"""So long a vehicle that was found fit is taken for it."""
PATIENCE_S = 3.0
"""What is red for no longer is not worth a word: after booting much is unknown at first."""


class Recheck:
    """Of one vehicle, in its event loop."""

    def __init__(
        self,
        preparation: Preparation,
        executor: Executor,
        now_s: Callable[[], float],
        events: Callable[[str, str], None],
    ) -> None:
        self._preparation, self._executor, self._now_s, self._events = preparation, executor, now_s, events
        self._task: asyncio.Task[None] | None = None
        self._began_s = -math.inf
        self._told: list[str] = []
        self._fit_s = -math.inf
        self._result: Prepared | None = None

    def begin(self) -> None:
        """From the first step on, also if it is under way."""
        self._began_s = self._now_s()
        self._preparation.start_over(self._began_s)
        self._fit_s, self._result = -math.inf, None
        if not self.is_running:
            self._told = []
            self._task = asyncio.get_running_loop().create_task(self._run(), name="recheck")

    @property
    def is_running(self) -> bool:
        """Or its result waits to be taken."""
        return self._result is not None or (self._task is not None and not self._task.done())

    @property
    def is_fit(self) -> bool:
        """Whether all was green a moment ago."""
        return self._now_s() - self._fit_s <= FRESH_S

    @property
    def error(self) -> BaseException | None:
        """Why it ended without a result."""
        if self._task is None or not self._task.done() or self._task.cancelled():
            return None
        return self._task.exception()

    def take(self) -> Prepared | None:
        """What the vehicle is flown by from now on; once after each check."""
        result, self._result = self._result, None
        return result

    def cancel(self) -> None:
        if self._task is not None:
            self._task.cancel()

    async def _run(self) -> None:
        self._result = await prepare_vehicle(
            self._preparation, self._executor, self._now_s, self._events, self._tell_red
        )
        self._fit_s = self._now_s()

    def _tell_red(self, faults: list[Item]) -> None:
        """What stays red, and when that is something else."""
        names = [item.name for item in faults]
        if names != self._told and self._now_s() - self._began_s > PATIENCE_S:
            red = "; ".join(f"{item.name}: {item.fault}" for item in faults)
            self._events("warning", f"not fit to fly again: {red}")
            self._told = names
