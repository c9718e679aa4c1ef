"""``python -m protocol.router``: the process through which all others of a mission talk.

It does nothing else, so that the ground station can die and come back while the drones go on hearing each other. In a
fleet it is the door as well: it lets in who has a certificate that the register admits, and lets each do its own part
(`protocol.access`). SIGHUP makes it read certificates and register again.
"""

from __future__ import annotations

import asyncio
import logging
import signal
import sys
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

from protocol.access import access_control
from protocol.aggregator import gathering
from protocol.bus import Bus, connect
from protocol.credentials import Credentials, load_credentials, load_register
from protocol.errors import CredentialsError
from protocol.mission import Mission
from protocol.process import Arguments, run_process
from protocol.refusals import refusals_told
from protocol.session import Link, namespace_of

log = logging.getLogger(__name__)


async def route(arguments: Arguments) -> None:
    """Listen at the endpoint until cancelled.

    Raises:
        BusError: the endpoint is malformed or taken.
        CredentialsError: the register cannot be read.
    """
    mission, link = arguments.mission, arguments.link
    changed = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGHUP, changed.set)
    if link.credentials is not None:
        with refusals_told(namespace_of(mission.name)):
            await _guard(mission, link, link.credentials, changed, lockstep=arguments.lockstep)
    async with (
        connect(link, mission.name, router=True, uplinks=mission.transport.uplinks) as bus,
        gathering(bus, mission, lockstep=arguments.lockstep),
    ):
        log.info("listening at %s", link.endpoint)
        await asyncio.Event().wait()


async def _guard(
    mission: Mission, link: Link, credentials: Credentials, changed: asyncio.Event, *, lockstep: bool
) -> None:
    """Listen, and listen anew whenever the certificates have changed; until cancelled."""
    admitted = _admitted(credentials)
    while True:
        access = access_rules(mission, admitted)
        async with (
            connect(link, mission.name, router=True, uplinks=mission.transport.uplinks, access=access) as bus,
            gathering(bus, mission, lockstep=lockstep),
        ):
            log.info("listening at %s for %s", link.endpoint, ", ".join(admitted) or "nobody: issue certificates")
            _watch(bus, admitted)
            credentials, admitted = await _next(credentials, changed)
        link = replace(link, credentials=credentials)


async def _next(credentials: Credentials, changed: asyncio.Event) -> tuple[Credentials, Sequence[str]]:
    """Certificate and register once there is a register that can be gone on with."""
    while True:
        await changed.wait()
        changed.clear()
        try:
            admitted = _admitted(credentials)
        except CredentialsError as error:
            log.error("goes on with the register it has: %s", error)  # noqa: TRY400  # the message says all
            continue
        try:
            credentials = load_credentials(credentials.folder, credentials.identity, now=datetime.now(UTC))
        except CredentialsError as error:  # whom it admits must not wait for that
            log.error("goes on with the certificate it has: %s", error)  # noqa: TRY400  # likewise
        log.warning("certificates read again; all links are closed, and open again within a second or two")
        return credentials, admitted


def _admitted(credentials: Credentials) -> Sequence[str]:
    return load_register(credentials.folder).admitted(datetime.now(UTC))


def access_rules(mission: Mission, admitted: Sequence[str]) -> dict[str, Any]:
    """Of the router of ``mission``, for those whom the register admits."""
    return access_control(namespace_of(mission.name), {drone.id for drone in mission.drones}, admitted)


def _watch(bus: Bus, admitted: Sequence[str]) -> None:
    def told(address: str, name: str, *, there: bool) -> None:
        if not there:
            log.info("%s (%s) is gone", name, address)
        elif name in admitted:
            log.info("%s is there, from %s", name, address)
        else:
            log.warning("refused: %s (%s) is not in the register, revoked or expired: it may do nothing", name, address)

    bus.watch_links(told)


if __name__ == "__main__":
    sys.exit(run_process("protocol.router", route))
