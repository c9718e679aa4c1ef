"""Keyframes to jumps: hands images to the map's worker thread, looks at the map on time, and lets phi jump.

The event loop never waits for the map, except in lockstep, where a jump is awaited when it is about to take effect: so
the same mission gives the same jumps at the same ticks however fast the machine is.
"""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

from ground_station.evaluation import Scores
from ground_station.feedback import FeedbackSchedule
from ground_station.jump_publisher import JumpPublisher
from ground_station.keyframe_backlog import KeyframeBacklog
from ground_station.mapper import Mapper, MapUpdate
from ground_station.reconstruction.memory import MEGABYTE
from ground_station.reconstruction.reconstructor import Mesh
from ground_station.recording.recorder import Recorder
from protocol import topics
from protocol.messages import Keyframe
from protocol.mission import Mission
from protocol.news import Tell

T = TypeVar("T")

SCORE_PERIOD_S = 10.0
"""Mission time between two live F-scores."""
LEAD_TICKS = 8
"""How far ahead of this process the simulator may fly in lockstep; in real time, how long a jump gets to travel."""
LOOKS_WAITING = 2
"""Map updates that may wait in real time; while so many do, none is begun."""


@dataclass(slots=True)
class _Update:
    """A map update that is being computed."""

    tick: int
    effective: int
    importance: float
    task: asyncio.Task[MapUpdate]


class MapFeedback:
    def __init__(
        self,
        mission: Mission,
        mapper: Mapper,
        jumps: JumpPublisher,
        recorder: Recorder,
        tell: Tell,
        *,
        lockstep: bool,
        backlog: KeyframeBacklog | None = None,
    ) -> None:
        """``tell``: who wants to know when the map is too slow, or too large."""
        self._mission, self._mapper, self._jumps, self._lockstep = mission, mapper, jumps, lockstep
        self._recorder, self._tell = recorder, tell
        self._backlog = backlog or KeyframeBacklog(mission.camera)
        self._told: set[str] = set()
        self._schedule = FeedbackSchedule(mission.feedback, mission.tick_s)
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="mapper")
        self._adding: set[asyncio.Task[None]] = set()
        self._updates: deque[_Update] = deque()
        self._received: deque[Keyframe] = deque()
        self._newest: dict[int, int] = {}
        self._tick = 0
        self._scored_at = -math.inf
        self.received = 0
        self.handed = 0
        """Keyframes given to the map; in lockstep the simulator may be some ticks and images ahead."""
        self.mapped = 0
        self.dropped = 0
        """Keyframes that were lost on the way."""
        self._closed = False
        self.scores: Scores | None = None
        self.mesh: Mesh | None = None
        """The newest."""

    @property
    def backlog(self) -> int:
        """Keyframes that wait for the map, or that it is taking in."""
        return self._backlog.waiting + self.handed - self.mapped

    @property
    def passed_over(self) -> int:
        """Keyframes for which there was no time; they are in the log."""
        return self._backlog.passed_over

    @property
    def unused(self) -> int:
        """Keyframes that did not make it into the map."""
        return self.dropped + self._backlog.passed_over + self._backlog.lost + self._mapper.refused

    def resume(self, restore: Callable[[], None], *, sent: int) -> None:
        """Go on after a restart: ``restore`` the map first; ``sent`` keyframes were sent so far, in all."""
        self.handed = self.mapped = self._mapper.taken
        self.received = sent
        self.dropped = max(0, sent - self.handed)
        self._track(asyncio.create_task(self.on_worker(restore)))

    def hear(self, keyframe: Keyframe) -> None:
        """Also notices those before it that never came."""
        self.received += 1
        self._recorder.heard(topics.KEYFRAME, keyframe, keyframe.tick)
        newest = self._newest.get(keyframe.drone, keyframe.sequence - 1)
        if keyframe.sequence < newest:  # counted as lost when a later one came first
            self.dropped = max(0, self.dropped - 1)
        else:
            self.dropped += max(0, keyframe.sequence - newest - 1)
            self._newest[keyframe.drone] = keyframe.sequence
        self._received.append(keyframe)

    def hand_over(self, tick: int) -> None:
        """Hand what was photographed before ``tick`` to the map, in an order that does not depend on arrival."""
        ready = sorted(
            (keyframe for keyframe in self._received if keyframe.tick < tick),
            key=lambda keyframe: (keyframe.tick, keyframe.drone),
        )
        self._received = deque(keyframe for keyframe in self._received if keyframe.tick >= tick)
        self._tick = tick
        if not ready:
            return
        if self._lockstep:
            self._map(ready)
            return
        self._backlog.put(ready)
        if self._backlog.passed_over:
            self._say_once(
                "slow",
                "the map is slower than images come: those that show the least new are passed over, and kept for "
                "covrecon reconstruct",
            )
        self._go_on()

    def _go_on(self) -> None:
        """Give the map what waits, one turn at a time: meanwhile it is decided what it can best do without."""
        if self._adding:
            return
        turn = self._backlog.take()
        if turn.passed_over or turn.keyframes:
            self._map(turn.keyframes, turn.passed_over)

    def _map(self, keyframes: Sequence[Keyframe], passed_over: Sequence[Keyframe] = ()) -> None:
        self.handed += len(keyframes)
        if keyframes:
            self._recorder.handed_over(self._tick, keyframes)
        self._track(asyncio.create_task(self._add(keyframes, passed_over)))

    def _track(self, task: asyncio.Task[None]) -> None:
        self._adding.add(task)
        task.add_done_callback(self._done)

    def _done(self, task: asyncio.Task[None]) -> None:
        self._adding.discard(task)
        if not (self._lockstep or task.cancelled() or self._closed):
            self._go_on()

    def _say_once(self, what: str, text: str) -> None:
        if what not in self._told:
            self._told.add(what)
            self._tell("warning", "map", text)

    async def _add(self, keyframes: Sequence[Keyframe], passed_over: Sequence[Keyframe]) -> None:
        def add() -> None:  # at once: what is recorded is the order in which the worker is asked
            if passed_over:
                self._mapper.keep(passed_over)
            if keyframes:
                self._mapper.add(keyframes)

        await self.on_worker(add)
        self.mapped += len(keyframes)

    async def on_worker(self, work: Callable[[], T]) -> T:
        """Do ``work`` on the thread that owns the map, after all that was given to it before."""
        return await asyncio.get_running_loop().run_in_executor(self._worker, work)

    def look(self, tick: int, importance: float) -> None:
        """Begin a map update if one is due at ``tick``, with J at that tick."""
        if not self._schedule.is_due(tick) or (not self._lockstep and len(self._updates) >= LOOKS_WAITING):
            return
        time_s = tick * self._mission.tick_s
        scored = time_s - self._scored_at >= SCORE_PERIOD_S
        if scored:
            self._scored_at = time_s
        self._recorder.looked(tick, importance)
        task = asyncio.create_task(self.on_worker(lambda: self._mapper.update(scored=scored)))
        self._updates.append(_Update(tick, self._schedule.effective_tick(tick), importance, task))

    async def settle(self, tick: int) -> None:
        """Turn finished updates into jumps.

        In lockstep exactly when one is about to take effect, and then it is waited for: what is recorded does not
        depend on how fast the machine was.
        """
        while self._updates:
            update = self._updates[0]
            if not (update.effective <= tick + 1 if self._lockstep else update.task.done()):
                return
            result = await update.task
            self._updates.popleft()
            self.scores = result.scores or self.scores
            self.mesh = result.mesh
            self._check_memory()
            self._recorder.mesh(update.tick, result.mesh)
            increments = self._schedule.increments(result.change, update.importance)
            if increments is not None:
                effective = update.effective if self._lockstep else max(update.effective, tick + LEAD_TICKS)
                jump = await self._jumps.publish(increments, effective)
                if jump is not None:
                    self._recorder.jumped(update.tick, jump, tick)

    def settled_until(self, tick: int) -> int:
        """The last tick for which no further jump can come, said at ``tick``; at least ``tick`` + 1 in lockstep."""
        if not self._lockstep:
            return tick + LEAD_TICKS - 1
        done = min(self._schedule.settled_after(tick), tick + LEAD_TICKS)
        if self._updates:
            done = min(done, self._updates[0].effective - 1)
        return max(done, tick + 1)

    async def finish(self) -> MapUpdate:
        """The complete map, scored."""
        for update in self._updates:
            update.task.cancel()
        while self._adding:  # each that ends begins the next
            await asyncio.wait(self._adding)
        result = await self.on_worker(self._mapper.finish)
        self.scores = result.scores or self.scores
        self.mesh = result.mesh
        return result

    def _check_memory(self) -> None:
        limit_mb = self._mission.reconstruction.memory_limit_mb
        taken_mb = self._mapper.memory_bytes / MEGABYTE
        if taken_mb > limit_mb:
            self._say_once(
                "memory",
                f"the map takes {taken_mb:.0f} MB, more than reconstruction.memory_limit_mb {limit_mb:g}, of which "
                f"{self.mesh.size_bytes / MEGABYTE if self.mesh else 0:.0f} MB its mesh; larger voxels need less",
            )

    def close(self) -> None:
        self._closed = True
        self._worker.shutdown(wait=False, cancel_futures=True)
