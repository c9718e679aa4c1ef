"""Operators' commands on their way: each is asked for again until the ground station and every drone has acknowledged.

Only the newest command for a drone is repeated. One that found no ground station is given up soon: it must not be
obeyed minutes later, when whoever pressed the button has forgotten it.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal

from protocol import topics
from protocol.bus import Bus
from protocol.errors import BusError
from protocol.messages import CommandReply
from protocol.verbs import ASK_AGAIN_S, ASK_TIMEOUT_S, Verb, command_parameters

log = logging.getLogger(__name__)

UNANSWERED_S = 5.0
"""For so long a command that nobody answers is repeated; a ground station that is started again takes longer."""
KEPT = 5
"""Commands whose state is shown."""

Progress = Literal["asked", "awaited", "acknowledged", "refused", "unanswered", "replaced"]
"""asked: not answered yet; awaited: accepted, and not yet heard by all drones; unanswered: given up, and perhaps
obeyed; replaced: given up for a newer one, which all of its drones get."""


@dataclass(frozen=True, slots=True)
class Sent:
    """A command, and how far it is."""

    id: str
    verb: Verb
    drones: tuple[int, ...]
    """Empty: all."""
    progress: Progress
    text: str = ""
    """What the ground station answered."""
    awaited: tuple[int, ...] = ()
    """Drones that have not acknowledged it."""
    link: bool = True
    """Whether the newest question was answered."""

    @property
    def is_over(self) -> bool:
        return self.progress not in ("asked", "awaited")

    def replaces(self, other: Sent) -> bool:
        """Whether each drone of ``other`` has this one to obey. Nothing takes the end of the mission back."""
        if other.verb in ("start", "abort"):
            return False
        return not self.drones or (bool(other.drones) and set(other.drones) <= set(self.drones))


class CommandSender:
    """Belongs to the event loop of ``bus``."""

    def __init__(self, bus: Bus, changed: Callable[[], None]) -> None:
        """``changed``: called when the progress of a command has."""
        self._bus, self._changed = bus, changed
        self._sent: deque[Sent] = deque(maxlen=KEPT)
        self._tasks: dict[str, asyncio.Task[None]] = {}

    @property
    def newest_first(self) -> tuple[Sent, ...]:
        return tuple(reversed(self._sent))

    def send(self, verb: Verb, drones: tuple[int, ...] = ()) -> None:
        """To ``drones``, without any to all; says at once that it is asked for, and later what became of it."""
        command = Sent(secrets.token_hex(8), verb, drones, "asked")
        for older in [known for known in self._sent if not known.is_over and command.replaces(known)]:
            self._tasks[older.id].cancel()
            self._note(replace(older, progress="replaced", awaited=()))
        self._sent.append(command)
        task = asyncio.create_task(self._insist(command))
        self._tasks[command.id] = task
        task.add_done_callback(lambda _: self._tasks.pop(command.id, None))
        log.info("command %s: %s", verb, "all drones" if not drones else f"drones {drones}")
        self._changed()

    async def close(self) -> None:
        tasks = list(self._tasks.values())
        for task in tasks:
            task.cancel()
        for task in tasks:
            with suppress(asyncio.CancelledError):
                await task

    async def _insist(self, command: Sent) -> None:
        question = command_parameters(command.id, command.verb, command.drones)
        clock = asyncio.get_running_loop().time
        deadline = clock() + UNANSWERED_S
        while not command.is_over:
            try:
                reply = await self._bus.ask(topics.COMMAND, question, timeout_s=ASK_TIMEOUT_S)
                command = _answered(command, reply)
            except BusError:
                given_up = command.progress == "asked" and clock() > deadline
                command = replace(command, link=False, progress="unanswered" if given_up else command.progress)
            self._note(command)
            if not command.is_over:
                await asyncio.sleep(ASK_AGAIN_S)

    def _note(self, command: Sent) -> None:
        for place, known in enumerate(self._sent):
            if known.id == command.id and known != command:
                self._sent[place] = command
                self._changed()


def _answered(command: Sent, reply: CommandReply) -> Sent:
    if not reply.accepted:
        return replace(command, progress="refused", text=reply.text, awaited=(), link=True)
    progress: Progress = "awaited" if reply.awaited else "acknowledged"
    return replace(command, progress=progress, text=reply.text, awaited=reply.awaited, link=True)
