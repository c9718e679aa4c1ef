"""Where operators' commands come in: each is checked, written to disk, obeyed, and told until it is acknowledged."""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from collections.abc import Callable

from ground_station.command_log import CommandLog
from ground_station.commands import CommandDesk, parse_command, refusal
from protocol import topics
from protocol.bus import Bus
from protocol.messages import CommandReply, DroneOrder, DroneState, Phase
from protocol.mission import Mission

log = logging.getLogger(__name__)

REFUSALS_KEPT = 1000
"""Refused commands whose ids are remembered: an id that was refused once must not come to mean something later."""


class CommandService:
    def __init__(
        self,
        mission: Mission,
        bus: Bus,
        log: CommandLog,
        *,
        phase: Callable[[], Phase],
        changed: Callable[[str], None],
    ) -> None:
        """``phase``: of the mission, now. ``changed``: called with what was commanded, in words, after it counts."""
        self._log, self._phase, self._changed = log, phase, changed
        vehicles = mission.vehicles
        clears_swapped = vehicles.kind == "px4" and vehicles.battery_swap_s > 0 and vehicles.swapped == "on_command"
        self._desk = CommandDesk([drone.id for drone in mission.drones], clears_swapped=clears_swapped)
        self._one_at_a_time = asyncio.Lock()
        self._refusals: dict[str, str] = {}
        self._said_again: Counter[str] = Counter()
        """How often a command came after its asker had been told that it is done with."""
        for command in log.earlier:
            self._desk.take(command)
        bus.serve(topics.COMMAND, self._answer)

    @property
    def orders(self) -> tuple[DroneOrder, ...]:
        return self._desk.orders

    @property
    def started(self) -> bool:
        return self._desk.started

    @property
    def aborted(self) -> bool:
        return self._desk.aborted

    @property
    def unwritten(self) -> int:
        return self._log.unwritten

    def hear(self, state: DroneState) -> None:
        self._desk.acknowledge(state.drone, state.obeyed)

    async def _answer(self, parameters: dict[str, str]) -> CommandReply:
        """Raises `MessageError` for what is no command."""
        identity, verb, drones = parse_command(parameters)
        async with self._one_at_a_time:
            if self._desk.known(identity) or identity in self._refusals:
                return self._repeat(identity)
            command = self._desk.consider(identity, verb, drones, self._phase())
            if isinstance(command, str):
                if len(self._refusals) >= REFUSALS_KEPT:
                    del self._refusals[next(iter(self._refusals))]
                self._refusals[identity] = command
                return refusal(identity, command)
            written = await asyncio.to_thread(self._log.append, command)
            # A disk that refuses must not keep a drone in the air.
            self._desk.take(command)
            reply = self._desk.reply(identity)
            if not written:
                reply = reply.model_copy(update={"text": f"{reply.text} (not on disk: forgotten if I die)"})
            self._changed(reply.text)
            return reply

    def _repeat(self, identity: str) -> CommandReply:
        """What has become of it; nothing is done again."""
        if identity in self._refusals:
            return refusal(identity, self._refusals[identity])
        reply = self._desk.reply(identity)
        if not reply.awaited:
            again = self._said_again[identity]
            self._said_again[identity] += 1
            if again.bit_count() == 1:  # not the first time, which tells the asker
                log.warning(
                    "command %d (%s) came again, though all have heard it: not obeyed", reply.number, reply.text
                )
        return reply
