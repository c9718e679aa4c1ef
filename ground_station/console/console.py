"""The console's process: hears what everybody says, keeps phi as the team does, and draws it for who looks.

It takes no part in the mission: nobody waits for it, and what it commands goes through the ground station.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from contextlib import AsyncExitStack
from functools import partial
from pathlib import Path

from ground_station.console.page import Page
from ground_station.console.server import serving
from ground_station.console.situation import Situation
from protocol import topics
from protocol.bus import Bus, connect
from protocol.clock import clock_of
from protocol.errors import BusError
from protocol.importance import compile_kernels
from protocol.messages import DroneState
from protocol.mission import Mission
from protocol.replication import Replication
from protocol.session import Link
from protocol.synchroniser import Synchroniser

log = logging.getLogger(__name__)

DRONES_PERIOD_S, PANELS_PERIOD_S, FIELD_PERIOD_S, MAP_PERIOD_S = 0.1, 0.5, 1.0, 1.0
"""Wall time between two pictures of each, while somebody looks."""
IDLE_TIMEOUT_S = 1.0
ONLOOKER = -1
"""In place of a drone's number: whoever has no part in the mission fetches phi like a drone."""


class Console:
    def __init__(self, mission: Mission, bus: Bus, page: Page, situation: Situation, *, lockstep: bool) -> None:
        self._bus, self._page, self._situation = bus, page, situation
        self._wait_ticks = round(mission.replication.wait_s / mission.tick_s)
        self._clock = clock_of(mission, bus, lockstep=lockstep)
        self._replication = Replication(mission)
        self._synchroniser = Synchroniser(bus, self._replication, ONLOOKER)
        self._failures = 0
        bus.on(topics.TICK, self._replication.hear_tick)
        bus.on(topics.STATE, self._hear_state, wakes=False)
        bus.on(topics.JUMP, self._replication.hear_jump)
        bus.on(topics.HEAD, self._replication.hear_head)
        bus.on(topics.DIGEST, self._replication.hear_digest)
        bus.on(topics.KEYFRAME, situation.hear_keyframe, wakes=False)
        bus.on(topics.EVENT, situation.hear_event)
        bus.on(topics.GROUND_EVENT, situation.hear_event)
        bus.on(topics.PHASE, situation.hear_phase)
        bus.on(topics.STATUS, situation.hear_status)
        if mission.flight.obstacles.enabled:
            bus.on(topics.FREE, situation.hear_free, wakes=False)
        bus.watch_lives()

    def _hear_state(self, state: DroneState) -> None:
        self._replication.hear_state(state)
        self._situation.hear_state(state)

    async def run(self) -> None:
        """Until it is cancelled: also when all others are gone it shows what it knows."""
        async with self._synchroniser.running(), asyncio.TaskGroup() as tasks:
            for part in (self._follow_clock(), self._follow_map(), self._draw()):
                tasks.create_task(part)

    async def _follow_clock(self) -> None:
        while True:
            tick = await self._clock.next_tick(IDLE_TIMEOUT_S)
            if tick is None:
                self._bus.poll()  # drones speak on when nobody beats the time
            elif not self._clock.backlog:
                self._replication.integrate(tick.tick, self._bus.gone, self._wait_ticks)
                await asyncio.sleep(0)

    async def _follow_map(self) -> None:
        while True:
            complete = True
            if self._page.is_watched and "ground" in self._bus.alive:
                try:
                    page = await self._bus.ask(topics.MAP, self._page.map.parameters)
                    redraw = self._page.map.take(page)
                    self._try(partial(self._page.draw_map, redraw))
                    complete = redraw.complete
                except BusError as error:
                    log.info("map: %s", error)
            if complete:
                await asyncio.sleep(MAP_PERIOD_S)

    async def _draw(self) -> None:
        """Each picture when it is due; nothing while nobody looks."""
        clock = asyncio.get_running_loop().time
        panels_s = field_s = clock()
        while True:
            await asyncio.sleep(DRONES_PERIOD_S)
            if not self._page.is_watched:
                continue
            due = [self._page.draw_drones]
            if clock() >= panels_s:
                panels_s = clock() + PANELS_PERIOD_S
                due.append(lambda: self._page.draw_panels(self._bus.alive))
            if clock() >= field_s:
                field_s = clock() + FIELD_PERIOD_S
                due.append(self._draw_field)
            for draw in due:
                self._try(draw)

    def _draw_field(self) -> None:
        self._page.draw_field(self._replication.replica.field if self._replication.known else None)

    def _try(self, draw: Callable[[], None]) -> None:
        """A picture that cannot be drawn must not take the buttons with it."""
        try:
            draw()
        except Exception:
            self._failures += 1
            if self._failures.bit_count() == 1:  # the 1st, 2nd, 4th ...: it would fill the disk
                log.exception("drawing failed %d times so far", self._failures)


async def run_console(mission: Mission, link: Link, run: Path, *, lockstep: bool) -> None:
    """Show ``mission`` in browsers until cancelled.

    Raises:
        BusError: the page's address is taken, or nobody listens where ``link`` leads.
        ProcessError: this viser cannot be guarded.
    """
    logging.getLogger("websockets.server").setLevel(logging.WARNING)  # it tells of each page that it sends
    compile_kernels()
    async with AsyncExitStack() as stack:
        server = stack.enter_context(serving(mission.console, f"covrecon · {mission.name}", run))
        bus = await stack.enter_async_context(connect(link, mission.name))
        situation = Situation(mission, asyncio.get_running_loop().time)
        page = Page(server, mission, bus, situation)
        stack.push_async_callback(page.close)
        await Console(mission, bus, page, situation, lockstep=lockstep).run()
