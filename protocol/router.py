"""``python -m protocol.router``: the process through which all others of a mission talk.

It does nothing else, so that the ground station can die and come back while the drones go on hearing each other.
"""

from __future__ import annotations

import asyncio
import logging
import sys

from protocol.bus import connect
from protocol.process import Arguments, run_process

log = logging.getLogger(__name__)


async def route(arguments: Arguments) -> None:
    """Listen at the endpoint until cancelled.

    Raises:
        BusError: the endpoint is malformed or taken.
    """
    async with connect(arguments.endpoint, arguments.mission.name, router=True):
        log.info("listening at %s", arguments.endpoint)
        await asyncio.Event().wait()


if __name__ == "__main__":
    sys.exit(run_process("protocol.router", route))
