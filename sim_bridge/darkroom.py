"""Keyframes from poses to the bus, beside the clock: rendered and sent on a thread of their own."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from protocol import topics
from protocol.bus import Bus
from protocol.geometry import Floats

if TYPE_CHECKING:
    from sim_bridge.photographer import Photographer, Shot, Sight

log = logging.getLogger(__name__)

BACKLOG = 64
"""Keyframes that may wait to be rendered in real time; beyond it they are lost and counted."""


class Darkroom:
    def __init__(self, bus: Bus, photographer: Photographer | None) -> None:
        """None: nobody has a camera."""
        self._bus, self._photographer = bus, photographer
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="camera")
        self._rendering: set[asyncio.Task[None]] = set()
        self.sent = 0
        """Keyframes so far."""
        self.lost = 0

    async def photograph(
        self, tick: int, poses: Mapping[int, Floats], velocities: Mapping[int, Floats], *, wait: bool
    ) -> None:
        """Take the keyframes that are due at ``tick``; ``poses`` and ``velocities`` (5,) by drone. ``wait``: until they
        are sent."""
        if self._photographer is not None:
            await self._take(self._photographer, self._photographer.due(tick, poses, velocities), wait=wait)

    async def photograph_believed(self, sights: Iterable[Sight], *, wait: bool) -> None:
        """Likewise, of drones that do not know quite where they are."""
        if self._photographer is not None:
            await self._take(self._photographer, self._photographer.due_of(sights), wait=wait)

    async def _take(self, photographer: Photographer, shots: Iterable[Shot], *, wait: bool) -> None:
        for shot in shots:
            if wait:
                await self._shoot(photographer, shot)
            elif len(self._rendering) >= BACKLOG:
                self.lost += 1
            else:
                task = asyncio.create_task(self._shoot(photographer, shot))
                self._rendering.add(task)
                task.add_done_callback(self._rendering.discard)

    async def _shoot(self, photographer: Photographer, shot: Shot) -> None:
        def shoot() -> None:  # also sends, which may take long on a congested link
            self._bus.put(topics.KEYFRAME, photographer.take(shot), shot.drone)

        await asyncio.get_running_loop().run_in_executor(self._worker, shoot)
        self.sent += 1

    def close(self) -> None:
        self._worker.shutdown(cancel_futures=True)
        if self.lost:
            log.warning("%d keyframes were due faster than they could be rendered and are lost", self.lost)
