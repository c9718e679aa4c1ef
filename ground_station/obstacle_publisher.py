"""Tells the drones what the map has seen free, as often as the mission says.

A map of free cells takes effect one period after it was begun, at a tick that is known before: in lockstep it is waited
for then, so that every drone flies by the same map at the same tick however fast the machine is. In real time it is
told as soon as it is there.
"""

from __future__ import annotations

import asyncio
from collections import deque
from dataclasses import dataclass

from ground_station.map_feedback import MapFeedback
from ground_station.mapper import Mapper
from ground_station.recording.recorder import Recorder
from protocol import topics
from protocol.bus import Bus
from protocol.messages import FreeCells
from protocol.mission import Mission
from protocol.obstacle_grid import Cells, ObstacleGrid, period_ticks


@dataclass(frozen=True, slots=True)
class _Look:
    effective: int
    task: asyncio.Task[Cells]


class ObstaclePublisher:
    """Of a mission with obstacles."""

    def __init__(
        self, mission: Mission, bus: Bus, mapper: Mapper, feedback: MapFeedback, recorder: Recorder, *, lockstep: bool
    ) -> None:
        self._bus, self._mapper, self._feedback, self._recorder = bus, mapper, feedback, recorder
        self._lockstep = lockstep
        self._grid, self._period = ObstacleGrid.of(mission), period_ticks(mission)
        self._looks: deque[_Look] = deque()
        self._looked = -1
        """Number of the period of the newest look."""

    def look(self, tick: int) -> None:
        """Begin a map at ``tick`` if one is due: of all keyframes that were handed over by now."""
        number = tick // self._period
        if self._looked < 0:  # first: after a restart the drones wait for what is in effect by now
            self._begin(number * self._period)
        if number > self._looked:
            self._begin((number + 1) * self._period)
            self._looked = number

    def _begin(self, effective: int) -> None:
        if not self._lockstep and any(not look.task.done() for look in self._looks):
            return  # the worker is behind; the next map has all of it
        task = asyncio.create_task(self._feedback.on_worker(lambda: self._mapper.free_cells(self._grid)))
        self._looks.append(_Look(effective, task))

    async def settle(self, tick: int) -> None:
        """Tell what is done; in lockstep exactly what takes effect by the next tick, and that is waited for."""
        while self._looks:
            look = self._looks[0]
            if not (look.effective <= tick + 1 if self._lockstep else look.task.done()):
                return
            free = await look.task
            self._looks.popleft()
            effective = look.effective if self._lockstep else tick
            self._bus.put(topics.FREE, FreeCells(tick=effective, packed=self._grid.pack(free), with_vouched=True))
            self._recorder.free(effective, self._grid, free)

    def close(self) -> None:
        """Nobody flies by them any more."""
        for look in self._looks:
            look.task.cancel()
        self._looks.clear()
