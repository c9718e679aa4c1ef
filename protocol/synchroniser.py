"""Asks over the bus for what a replica of phi lacks, and answers others; the rules are `protocol.replication`'s.

It runs beside the control task and never holds it up: what cannot be had now is asked for again, ever less often.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress

from protocol import topics
from protocol.bus import Bus
from protocol.errors import MessageError, NoReply
from protocol.messages import PhiPage
from protocol.replication import JournalRequest, Replication, Request
from protocol.state_log import HISTORY_TICKS

log = logging.getLogger(__name__)

GRACE_S = 0.05
"""A jump that the head tells of may be on its way still; it is asked for only after this."""
RETRY_S, RETRY_MAX_S = 0.1, 1.0
"""First and longest pause after a query without an answer; it doubles in between."""
IDLE_S = 1.0
SERVE_PATIENCE_S = 1.5
"""How long an asker may wait for a tick that is not integrated yet; less than its query's time-out."""

Answer = Callable[[dict[str, str]], Awaitable[PhiPage]]


class Synchroniser:
    def __init__(
        self, bus: Bus, replication: Replication, own: int = 0, rank: Callable[[int], int] = lambda drone: drone
    ) -> None:
        """``own``: the drone of this process, which does not ask itself; 0 for the ground station; less for an
        onlooker, which asks like a drone. ``rank``: of those that may be asked, the drone with the lowest is first."""
        self._bus, self._replication, self._own, self._rank = bus, replication, own, rank

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Ask while the block runs."""
        task = asyncio.create_task(self._run())
        try:
            yield
        finally:
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task

    async def _run(self) -> None:
        wants = self._replication.wants
        pause = RETRY_S
        while True:
            if not await self._bus.until(lambda: wants() is not None, IDLE_S):
                continue
            if isinstance(wants(), JournalRequest):
                await asyncio.sleep(GRACE_S)
            request = wants()
            if request is None:
                continue
            if await self._fetch(request):
                pause = RETRY_S
            else:
                await asyncio.sleep(pause)
                pause = min(2 * pause, RETRY_MAX_S)

    async def _fetch(self, request: Request) -> bool:
        """Ask for ``request``; whether an answer came that could be used."""
        try:
            if isinstance(request, JournalRequest):
                jumps = await self._bus.ask(topics.JOURNAL, f"from={request.first};to={request.last}")
                self._replication.hear_journal(jumps, request)
            else:
                blocks = "+".join(str(block) for block in request.blocks)
                page = await self._ask_blocks(f"blocks={blocks};from={request.tick}")
                self._replication.hear_page(page)
        except (NoReply, MessageError) as error:
            log.info("phi: %s", error)
            return False
        self._bus.recheck()
        return True

    async def _ask_blocks(self, parameters: str) -> PhiPage:
        """From the ground station; without one, whoever knows nothing yet takes another drone's."""
        if self._own and "ground" in self._bus.alive:
            return await self._bus.ask(topics.BLOCKS, parameters)
        if self._replication.known:
            raise NoReply("no ground station to ask")
        drones = [int(role.removeprefix("drone/")) for role in self._bus.alive if role.startswith("drone/")]
        for drone in sorted(drones, key=self._rank):
            if drone != self._own:
                try:
                    return await self._bus.ask(topics.DRONE_BLOCKS, parameters, drone)
                except NoReply as error:
                    log.info("phi: %s", error)
        raise NoReply("no drone that has phi answers")


def blocks_of(replication: Replication) -> Answer:
    """The handler of queries for blocks of ``replication``'s phi: ``blocks=3+7;from=120``."""

    async def answer(parameters: dict[str, str]) -> PhiPage:
        try:
            blocks = [int(block) for block in parameters["blocks"].split("+")]
            tick = int(parameters["from"])
        except (KeyError, ValueError) as error:
            raise MessageError(f"blocks and from must be given as numbers: {parameters}") from error
        if tick > replication.replica.tick + HISTORY_TICKS:
            raise MessageError(f"tick {tick} is too far ahead")
        page: asyncio.Future[PhiPage] = asyncio.get_running_loop().create_future()

        def reply() -> None:
            try:
                if not page.done():
                    page.set_result(replication.page(blocks))
            except MessageError as error:
                page.set_exception(error)

        replication.when_reached(tick, reply)
        try:
            return await asyncio.wait_for(page, SERVE_PATIENCE_S)
        except TimeoutError as error:
            raise MessageError(f"tick {tick} is not integrated yet") from error

    return answer
