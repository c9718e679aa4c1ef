"""What an operator may command, and what has become of it: pure logic, no messages, no disk.

start    the mission, where it waits for it (`Mission.start`); for all drones
pause    hold the place until "resume"; on the ground, do not take off
return   fly to the start and land there; not taken back
land     come down here; not taken back
abort    land all, and end the mission

A command is known by its id: the same id again is the same command, however often it comes. What it means for a drone
is an order with the command's number, which the drone hears from the ground station again and again.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Literal, get_args

from protocol.errors import MessageError
from protocol.messages import CommandReply, DroneOrder, Phase
from protocol.verbs import Verb

Action = Literal["fly", "hold", "return", "land"]

ID_LETTERS = 64
_ACTIONS: Mapping[Verb, Action] = {
    "pause": "hold",
    "resume": "fly",
    "return": "return",
    "land": "land",
    "abort": "land",
}
_FROM: Mapping[Verb, frozenset[Action]] = {
    "pause": frozenset({"fly"}),
    "resume": frozenset({"hold"}),
    "return": frozenset({"fly", "hold"}),
    "land": frozenset({"fly", "hold", "return"}),
    "abort": frozenset({"fly", "hold", "return", "land"}),
}
"""Orders that a command replaces: who lands does not stop landing."""


@dataclass(frozen=True, slots=True)
class Command:
    id: str
    verb: Verb
    drones: tuple[int, ...]
    """Ascending; all of the mission's where none were named."""
    number: int
    """Counts from 1."""


def parse_command(parameters: Mapping[str, str]) -> tuple[str, Verb, tuple[int, ...]]:
    """Id, verb and drones out of ``id=..;verb=land;drones=3+4``; no drones where none are named.

    Raises:
        MessageError: it is no command.
    """
    identity, verb, named = (parameters.get(key, "") for key in ("id", "verb", "drones"))
    if not 0 < len(identity) <= ID_LETTERS or not identity.isalnum():
        raise MessageError(f"command: an id of 1 to {ID_LETTERS} letters and digits is needed, got {identity[:80]!r}")
    verbs: tuple[Verb, ...] = get_args(Verb)
    if verb not in verbs:
        raise MessageError(f"command: {verb[:80]!r} is none of {', '.join(verbs)}")
    try:
        drones = tuple(sorted({int(drone) for drone in named.split("+")} if named else ()))
    except ValueError as error:
        raise MessageError(f"command: drones must be numbers joined by +, got {named[:80]!r}") from error
    return identity, verbs[verbs.index(verb)], drones


class CommandDesk:
    """All commands of one mission."""

    def __init__(self, drones: Collection[int], *, clears_swapped: bool = False) -> None:
        """``clears_swapped``: drones that stand on the ground with another battery wait for a "resume"."""
        self._from = {**_FROM, "resume": _FROM["resume"] | {"fly"}} if clears_swapped else _FROM
        self._drones = tuple(sorted(drones))
        self._commands: dict[str, Command] = {}
        self._orders: dict[int, DroneOrder] = {}
        self._acknowledged: dict[int, int] = dict.fromkeys(self._drones, 0)
        self.started = False
        """Whether an operator has said "start"."""
        self.aborted = False

    @property
    def orders(self) -> tuple[DroneOrder, ...]:
        """Of every drone that was ever commanded something, by its number."""
        return tuple(self._orders[drone] for drone in sorted(self._orders))

    def known(self, identity: str) -> bool:
        return identity in self._commands

    def consider(self, identity: str, verb: Verb, drones: tuple[int, ...], phase: Phase) -> Command | str:
        """The command that this would be, or why it is refused; nothing is done yet."""
        unknown = [drone for drone in drones if drone not in self._drones]
        if unknown:
            known = ", ".join(map(str, self._drones))
            return f"there is no drone {', '.join(map(str, unknown))}; the mission has {known}"
        if drones and verb in ("start", "abort"):
            return f"{verb} is for the whole mission, not for single drones"
        if verb == "start" and phase != "waiting":
            return "the mission has started already" if phase != "finished" else "the mission is over"
        if phase == "finished" and verb in ("pause", "resume", "abort"):
            return "the mission is over"
        wanted = drones or self._drones
        if verb not in ("start", "abort") and not any(self._action(drone) in self._from[verb] for drone in wanted):
            return f"nothing to {verb}: {self._describe(wanted)}"
        # Drones may have heard of commands that this process has lost.
        newest = max([*(known.number for known in self._commands.values()), *self._acknowledged.values()], default=0)
        return Command(identity, verb, wanted, newest + 1)

    def take(self, command: Command) -> None:
        """Do it, or do it again after a restart."""
        self._commands[command.id] = command
        self.started = self.started or command.verb == "start"
        self.aborted = self.aborted or command.verb == "abort"
        if command.verb == "start":
            return
        for drone in command.drones:
            if self._action(drone) in self._from[command.verb]:
                order = DroneOrder(drone=drone, action=_ACTIONS[command.verb], number=command.number)
                self._orders[drone] = order

    def acknowledge(self, drone: int, number: int) -> None:
        """``drone`` says that it has heard the order with that number, and with it all before."""
        if drone in self._acknowledged:
            self._acknowledged[drone] = max(self._acknowledged[drone], number)

    def reply(self, identity: str) -> CommandReply:
        """What has become of a command that was taken."""
        command = self._commands[identity]
        awaited = [
            drone
            for drone in command.drones
            if (order := self._orders.get(drone)) is not None
            and order.number >= command.number > self._acknowledged[drone]
        ]
        return CommandReply(
            id=identity,
            accepted=True,
            text=f"{command.verb}: {_named(command.drones) if command.verb != 'start' else 'the mission'}",
            number=command.number,
            awaited=tuple(awaited),
        )

    def _action(self, drone: int) -> Action:
        order = self._orders.get(drone)
        return "fly" if order is None else order.action

    def _describe(self, drones: Iterable[int]) -> str:
        words = {"fly": "flies", "hold": "is paused", "return": "returns already", "land": "lands already"}
        return ", ".join(f"drone {drone} {words[self._action(drone)]}" for drone in drones)


def refusal(identity: str, why: str) -> CommandReply:
    return CommandReply(id=identity, accepted=False, text=why, number=0, awaited=())


def _named(drones: Iterable[int]) -> str:
    return ", ".join(f"drone {drone}" for drone in drones)
