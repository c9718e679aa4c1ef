"""An operator's command from the command line: asked of the ground station until every drone has acknowledged it."""

from __future__ import annotations

import asyncio
import json
import secrets
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from protocol import topics
from protocol.bus import Bus, connect
from protocol.credentials import OPERATOR
from protocol.errors import BusError, CommandError, MissionError, NoReply
from protocol.links import link_of
from protocol.messages import CommandReply
from protocol.mission_file import load_mission
from protocol.session import Link
from protocol.verbs import ASK_AGAIN_S, ASK_TIMEOUT_S, Verb, command_parameters

CONNECT_S = 5.0
"""How long the router may take to answer."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where a mission can be reached."""

    link: Link
    mission: str


def place_of(run: Path) -> Place:
    """Of the mission that flies in the folder ``run``.

    Raises:
        CommandError: it is no run's folder.
        CredentialsError: its endpoint wants a certificate, and there is none of an operator.
    """
    try:
        endpoint = str(json.loads((run / "run.json").read_bytes())["endpoint"])
        mission = load_mission(run / "mission.json")
    except (OSError, ValueError, KeyError, TypeError, MissionError) as error:
        why = error.strerror if isinstance(error, OSError) else str(error)
        raise CommandError(f"{run}: not the folder of a run ({why}); name it: --run runs/<time>") from error
    return Place(link_of(mission, OPERATOR, endpoint=endpoint), mission.name)


def place_of_mission(file: Path, operator: str = "") -> Place:
    """Of the mission of a fleet, from any computer with an operator's certificate.

    Args:
        operator: whose certificate to show; empty where there is only one.

    Raises:
        MissionError: it cannot be read.
        BusError: it does not say where its router is.
        CredentialsError: there is no certificate of an operator.
    """
    mission = load_mission(file)
    return Place(link_of(mission, f"{OPERATOR}-{operator}" if operator else OPERATOR), mission.name)


async def command(
    place: Place, verb: Verb, drones: Sequence[int], *, say: Callable[[str], None], patience_s: float
) -> None:
    """Command ``drones``, all without any, and wait until they have acknowledged it.

    Raises:
        CommandError: refused, or not acknowledged by everybody within ``patience_s``; it may still be obeyed then.
    """
    try:
        async with connect(place.link, place.mission, timeout_s=CONNECT_S) as bus:
            await _insist(bus, verb, drones, say, patience_s)
    except BusError as error:
        raise CommandError(f"{error}; does mission {place.mission!r} still fly?") from error


async def _insist(bus: Bus, verb: Verb, drones: Sequence[int], say: Callable[[str], None], patience_s: float) -> None:
    question = command_parameters(secrets.token_hex(8), verb, drones)
    clock = asyncio.get_running_loop().time
    deadline = clock() + patience_s
    newest: CommandReply | None = None
    while clock() < deadline:
        try:
            reply = await bus.ask(topics.COMMAND, question, timeout_s=ASK_TIMEOUT_S)
        except NoReply:
            continue
        if not reply.accepted:
            raise CommandError(f"refused: {reply.text}")
        if newest is None or reply.awaited != newest.awaited:
            say(f"{reply.text}: {_progress(reply)}")
        if not reply.awaited:
            return
        newest = reply
        await asyncio.sleep(ASK_AGAIN_S)
    if newest is None:
        raise CommandError(f"no ground station answered within {patience_s:g} s: as far as is known, nothing was done")
    raise CommandError(f"not acknowledged within {patience_s:g} s by drone {', '.join(map(str, newest.awaited))}")


def _progress(reply: CommandReply) -> str:
    return f"waiting for drone {', '.join(map(str, reply.awaited))}" if reply.awaited else "acknowledged"
