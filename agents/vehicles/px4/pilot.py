"""The background task that brings a vehicle into our hands and notices when it leaves them.

A thin shell around `AuthorityLogic`: telemetry in, commands out through the executor, one at a time, so that neither
the event loop nor the telemetry waits for an acknowledgement.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import Executor
from threading import Lock
from typing import Protocol

from agents.vehicles.px4.authority import AuthorityLogic, Observation, Step
from protocol.errors import VehicleError

PERIOD_S = 0.05


class Cockpit(Protocol):
    """What the pilot sees and reaches."""

    def observe(self) -> Observation: ...

    def command(self, step: Step) -> None:
        """Blocks. Raises: VehicleError: refused, or not answered."""
        ...

    def idle(self) -> None:
        """Keep setpoints coming while the control task must not send."""
        ...

    def watch(self) -> None:
        """Look after what is not the flight itself."""
        ...


class Pilot:
    """``lock`` guards ``logic``, which other threads use as well."""

    def __init__(
        self,
        cockpit: Cockpit,
        logic: AuthorityLogic,
        lock: Lock,
        executor: Executor,
        now_s: Callable[[], float],
        events: Callable[[str, str], None],
    ) -> None:
        self._cockpit, self._logic, self._lock, self._executor = cockpit, logic, lock, executor
        self._now_s, self._events = now_s, events
        self._said = self._unheeded = ""

    async def run(self) -> None:
        """Until cancelled."""
        async with asyncio.TaskGroup() as commands:
            while True:
                with self._lock:
                    step = self._logic.observe(self._cockpit.observe(), self._now_s())
                    phase, authority, reason = self._logic.phase, self._logic.authority, self._logic.reason
                    streams, unheeded = self._logic.streams, self._logic.unheeded
                if unheeded != self._unheeded:
                    self._events("warning", unheeded)
                    self._unheeded = unheeded
                self._report(phase, authority, reason)
                if streams:
                    self._cockpit.idle()
                self._cockpit.watch()
                if step != "wait":
                    commands.create_task(self._give(step))
                await asyncio.sleep(PERIOD_S)

    async def _give(self, step: Step) -> None:
        refusal = ""
        try:
            await asyncio.get_running_loop().run_in_executor(self._executor, self._cockpit.command, step)
        except VehicleError as error:
            refusal = str(error)
            self._events("warning", refusal)
        with self._lock:
            self._logic.answered(step, self._now_s(), refusal)

    def _report(self, phase: str, authority: str, reason: str) -> None:
        """Changes of who flies, and the reason at that moment: it tells progress afterwards, which is no event."""
        if self._said != phase + authority:
            level = "warning" if authority in ("yielded", "lost") else "info"
            self._events(level, f"{authority}: {reason}" if reason else authority)
            self._said = phase + authority
