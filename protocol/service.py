"""Tells whoever started this process that it is ready and alive: systemd by a socket, a container by a file's age.

The event loop itself says so, so one that hangs falls silent, and is noticed. Nothing is told where nobody asked for
it, and what cannot be told costs a warning, never the flight.
"""

from __future__ import annotations

import asyncio
import logging
import os
import socket
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from contextvars import ContextVar
from pathlib import Path

log = logging.getLogger(__name__)

SOCKET, WATCHDOG = "NOTIFY_SOCKET", "WATCHDOG_USEC"
"""Environment variables that systemd sets (sd_notify(3), sd_watchdog_enabled(3))."""
HEARTBEAT = "COVRECON_HEARTBEAT"
"""Environment variable with a file to be touched at each beat; deploy/docker/Dockerfile looks how old it is."""
PERIOD_S = 2.0
"""Between two beats where systemd does not say how patient it is."""

_current: ContextVar[Service] = ContextVar("service")


class Service:
    """What one process tells; make it with `told`."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get(SOCKET, "")
        self._address = f"\0{address[1:]}" if address.startswith("@") else address  # @: Linux's abstract names
        self._heartbeat = environment.get(HEARTBEAT, "")
        patience = environment.get(WATCHDOG, "")
        patience_s = int(patience) / 1e6 if patience.isdecimal() else 0.0
        self.period_s = patience_s / 2 if patience_s > 0 else PERIOD_S
        """systemd advises half of its patience."""
        self._status = ""
        self._failed = False

    def ready(self, status: str) -> None:
        """It does its work from now on; ``status`` is for people."""
        self._status = " ".join(status.split())
        self.beat()

    def beat(self) -> None:
        """Say all of it, in case what was said before got lost. Nothing before it is ready: systemd, once it has heard
        of a watchdog, would not be patient with a start that compiles for a minute."""
        if not self._status:
            return
        self._tell(f"READY=1\nWATCHDOG=1\nSTATUS={self._status}")
        if self._heartbeat:
            self._touch(Path(self._heartbeat))

    def stopping(self) -> None:
        self._tell("STOPPING=1\nSTATUS=ending")

    def _tell(self, message: str) -> None:
        if not self._address:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as datagrams:
                datagrams.sendto(message.encode(), self._address)
        except OSError as error:
            self._fail(SOCKET, error)

    def _touch(self, file: Path) -> None:
        try:
            file.touch()
        except OSError as error:
            self._fail(HEARTBEAT, error)

    def _fail(self, variable: str, error: OSError) -> None:
        if not self._failed:
            log.warning("%s: cannot tell that this process is alive: %s", variable, error.strerror or error)
        self._failed = True


@asynccontextmanager
async def told(environment: Mapping[str, str] = os.environ) -> AsyncIterator[None]:
    """While the block runs, `ready` may be called in it and in the tasks that it starts; after that, beats are told."""
    service = Service(environment)
    token = _current.set(service)
    beating = asyncio.create_task(_beat(service))
    try:
        yield
    finally:
        beating.cancel()
        service.stopping()
        _current.reset(token)


def ready(status: str) -> None:
    """The process that this is called in does its work from now on. In any other than those of a mission: nothing."""
    service = _current.get(None)
    if service is not None:
        service.ready(status)


async def _beat(service: Service) -> None:
    while True:
        await asyncio.sleep(service.period_s)
        service.beat()
