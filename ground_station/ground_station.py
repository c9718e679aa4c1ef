"""The ground station's process: keeps phi with the team, turns keyframes into a map, and sends drones back by jumps.

The event loop never waits for the map: a worker thread owns it (`ground_station.mapper`), and a jump takes effect a
fixed delay after the tick of its map, in every process alike. In lockstep the simulator waits for "done up to k", so
the same mission gives the same jumps at the same ticks however fast the machine is.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ground_station.evaluation import Scores
from ground_station.feedback import FeedbackSchedule
from ground_station.journal import Journal
from ground_station.mapper import Mapper, MapUpdate
from ground_station.rehearsal import rehearse
from ground_station.results import Metrics, RunFolder
from ground_station.status import StatusBoard
from protocol import topics
from protocol.bus import Bus, connect
from protocol.clock import SimulatorClock
from protocol.errors import MessageError
from protocol.field import VirtualField
from protocol.importance import ImportanceField, compile_kernels
from protocol.messages import DroneState, JournalPage, Jump, JumpHead, Keyframe, MissionPhase, Phase, Tick
from protocol.mission import Mission
from protocol.replica import Replica
from protocol.state_log import StateLog

log = logging.getLogger(__name__)

LOCKSTEP_PATIENCE_S = 20.0
"""Wall time to wait for a live drone's state or a keyframe in lockstep; it runs out only when a process hangs."""
REAL_TIME_PATIENCE_S = 0.02
IDLE_TIMEOUT_S = 1.0
METRICS_PERIOD_S = 1.0
"""Mission time between two rows of metrics.csv."""
CHECKPOINT_PERIOD_S = 60.0
"""Mission time between two writings of the trajectories, which take some tens of milliseconds."""
SCORE_PERIOD_S = 10.0
"""Mission time between two live F-scores."""
STATUS_PERIOD_S = 0.5
"""Wall time between two status messages."""
LEAD_TICKS, HEAD_EVERY_TICKS = 8, 4
"""How far ahead of this process the simulator may fly in lockstep, and how often it is told."""
JUMP_LEAD_TICKS = 4
"""In real time, a jump that came too late for its tick takes effect so many ticks after now: time to travel."""
KEYFRAME_BACKLOG = 200
"""Keyframes that may wait for the map in real time; beyond it the newest are dropped and counted."""


@dataclass(slots=True)
class _Update:
    """A map update that is being computed."""

    effective: int
    importance: float
    task: asyncio.Task[MapUpdate]


class GroundStation:
    def __init__(self, mission: Mission, bus: Bus, run: RunFolder, journal: Journal, *, lockstep: bool) -> None:
        self._mission, self._bus, self._run, self._journal, self._lockstep = mission, bus, run, journal, lockstep
        self._patience_s = LOCKSTEP_PATIENCE_S if lockstep else REAL_TIME_PATIENCE_S
        field = VirtualField.of(mission.target)
        self._log = StateLog()
        self._replica = Replica(ImportanceField(field, mission.sensing), journal.epoch)
        self._schedule = FeedbackSchedule(mission.feedback, mission.tick_s)
        self._mapper = Mapper(mission, field, run.path)
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="mapper")
        self._adding: set[asyncio.Task[None]] = set()
        self._updates: deque[_Update] = deque()
        self._clock = SimulatorClock(bus, lockstep=lockstep)
        self._board = StatusBoard(mission)
        self._received: deque[Keyframe] = deque()
        self._keyframes = 0
        self._handed = 0  # to the map; in lockstep the simulator may be some ticks and images ahead
        self._mapped = 0
        self._dropped = 0
        self._scores: Scores | None = None
        self._scored_at = -math.inf
        self._phase: Phase = "starting"
        self._reason = ""
        self._tick = 0
        self._promised = 0
        bus.on(topics.STATE, self._hear_state)
        bus.on(topics.KEYFRAME, self._hear_keyframe)
        bus.serve(topics.JOURNAL, self._answer)
        bus.watch_lives()

    # --- what comes in -------------------------------------------------------------------------------------------

    def _hear_state(self, state: DroneState) -> None:
        self._log.hear(state)
        self._board.hear(state)

    def _hear_keyframe(self, keyframe: Keyframe) -> None:
        self._keyframes += 1
        self._received.append(keyframe)

    def _answer(self, parameters: dict[str, str]) -> JournalPage:
        try:
            first, last = int(parameters.get("from", 0)), int(parameters.get("to", self._journal.next_sequence))
        except ValueError as error:
            raise MessageError(f"journal: from and to must be numbers: {parameters}") from error
        return JournalPage(
            epoch=self._journal.epoch,
            next_sequence=self._journal.next_sequence,
            jumps=self._journal.encoded(first, last),
        )

    # --- the mission ---------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """From the first tick until J is low enough, time is up, or the simulator is gone."""
        self._bus.announce("ground")
        telling = asyncio.create_task(self._tell())
        try:
            await self._fly()
            await self._finish()
        finally:
            telling.cancel()
            self._worker.shutdown(wait=False, cancel_futures=True)
            with suppress(asyncio.CancelledError):
                await telling
        self._publish_status()

    async def _fly(self) -> None:
        while not self._reason:
            tick = await self._clock.next_tick(IDLE_TIMEOUT_S)
            if tick is not None:
                self._phase = "flying"
                await self._step(tick)
                self._reason = self._end_of(tick)
                self._publish_head(tick.tick)
            elif self._phase == "flying" and "sim" not in self._bus.alive:
                self._reason = "the simulator is gone"

    async def _step(self, tick: Tick) -> None:
        self._tick = tick.tick
        complete = await self._bus.until(lambda: self._is_complete(tick), self._patience_s)
        if self._lockstep and not complete:
            log.warning("tick %d: going on without all states and keyframes: this run cannot be repeated", tick.tick)
        await self._map_keyframes(tick)
        await self._settle_updates(tick)
        ids, poses = self._log.poses_at(tick.tick, tick.live)
        self._replica.advance(tick.tick, poses, self._mission.tick_s)
        self._log.forget_before(tick.tick)
        self._board.note_lives(self._bus.alive)
        self._record(tick, dict(zip(ids, poses.tolist(), strict=True)))
        if self._schedule.is_due(tick.tick):
            self._start_update(tick)

    def _is_complete(self, tick: Tick) -> bool:
        waited_for = [drone for drone in tick.live if f"drone/{drone}" in self._bus.alive]
        arrived = self._keyframes >= tick.keyframes or not self._lockstep
        return arrived and self._log.has_all(tick.tick, waited_for)

    def _end_of(self, tick: Tick) -> str:
        """Why the mission is over after this tick; empty while it is not."""
        importance = self._replica.field.importance
        if importance < self._mission.stop_below:
            return f"importance fell below {self._mission.stop_below:g}"
        if (tick.tick + 1) * self._mission.tick_s >= self._mission.duration_s:
            return f"duration of {self._mission.duration_s:g} s reached"
        return ""

    # --- the map -------------------------------------------------------------------------------------------------

    async def _map_keyframes(self, tick: Tick) -> None:
        """Hand what was photographed before this tick to the map, in an order that does not depend on arrival."""
        ready = sorted(
            (keyframe for keyframe in self._received if keyframe.tick < tick.tick),
            key=lambda keyframe: (keyframe.tick, keyframe.drone),
        )
        self._received = deque(keyframe for keyframe in self._received if keyframe.tick >= tick.tick)
        if not ready:
            return
        self._handed += len(ready)
        if not self._lockstep and len(self._adding) >= KEYFRAME_BACKLOG:
            self._dropped += len(ready)
            return
        task = asyncio.create_task(self._add(ready))
        self._adding.add(task)
        task.add_done_callback(self._adding.discard)

    async def _add(self, keyframes: list[Keyframe]) -> None:
        await asyncio.get_running_loop().run_in_executor(self._worker, self._mapper.add, keyframes)
        self._mapped += len(keyframes)

    def _start_update(self, tick: Tick) -> None:
        scored = tick.time_s - self._scored_at >= SCORE_PERIOD_S
        if scored:
            self._scored_at = tick.time_s
        loop = asyncio.get_running_loop()

        async def compute() -> MapUpdate:
            return await loop.run_in_executor(self._worker, lambda: self._mapper.update(scored=scored))

        self._updates.append(
            _Update(
                effective=self._schedule.effective_tick(tick.tick),
                importance=self._replica.field.importance,
                task=asyncio.create_task(compute()),
            )
        )

    async def _settle_updates(self, tick: Tick) -> None:
        """Turn finished updates into jumps.

        In lockstep exactly when one is about to take effect, and then it is waited for: what is recorded does not
        depend on how fast the machine was.
        """
        while self._updates:
            update = self._updates[0]
            if not (update.effective <= tick.tick + 1 if self._lockstep else update.task.done()):
                return
            result = await update.task
            self._updates.popleft()
            self._scores = result.scores or self._scores
            effective = update.effective if self._lockstep else max(update.effective, tick.tick + JUMP_LEAD_TICKS)
            self._jump(result, update.importance, effective)

    def _jump(self, result: MapUpdate, importance: float, effective: int) -> None:
        increments = self._schedule.increments(result.change, importance)
        if increments is None:
            return
        jump = Jump(
            epoch=self._journal.epoch,
            sequence=self._journal.next_sequence,
            tick=effective,
            increments=increments,
        )
        encoded = self._journal.append(jump)
        self._bus.put_encoded(topics.JUMP, encoded)
        self._replica.hear(jump)

    # --- what goes out -------------------------------------------------------------------------------------------

    def _record(self, tick: Tick, poses: dict[int, list[float]]) -> None:
        controls = self._board.controls(poses)
        self._run.record_tick(
            tick.tick,
            tick.time_s,
            poses,
            {drone: control.solve_s for drone, control in controls.items()},
            {drone: control.slack for drone, control in controls.items()},
            {drone: control.outcome for drone, control in controls.items() if control.outcome != "solved"},
        )
        self._board.note_poses(poses)
        if tick.tick % max(1, round(METRICS_PERIOD_S / self._mission.tick_s)) == 0:
            self._run.record_metrics(self._metrics())
        if tick.tick % max(1, round(CHECKPOINT_PERIOD_S / self._mission.tick_s)) == 0:
            self._run.checkpoint()

    def _metrics(self) -> Metrics:
        return Metrics(
            time_s=self._tick * self._mission.tick_s,
            tick=self._tick,
            importance=self._replica.field.importance,
            scores=self._scores,
            jumps=self._journal.next_sequence,
            keyframes=self._handed,
        )

    def _publish_head(self, tick: int) -> None:
        """Say how far the simulator may go: not past a jump that is not out yet, nor far ahead of this process."""
        done = min(self._schedule.settled_after(tick), tick + LEAD_TICKS)
        if self._updates:
            done = min(done, self._updates[0].effective - 1)
        done = max(done, tick + 1)
        finished = bool(self._reason)
        awaited = self._promised <= tick + 1  # the simulator has used up what it was promised
        if not (finished or awaited or done - self._promised >= HEAD_EVERY_TICKS):
            return
        self._promised = done
        head = JumpHead(
            epoch=self._journal.epoch,
            next_sequence=self._journal.next_sequence,
            done=done,
            phase="finished" if finished else self._phase,
        )
        self._bus.put(topics.HEAD, head)

    def _publish_phase(self) -> None:
        self._bus.put(topics.PHASE, MissionPhase(phase=self._phase, reason=self._reason))

    async def _tell(self) -> None:
        """Status for people, and the phase repeated for whoever missed it."""
        while True:
            self._publish_status()
            self._publish_phase()
            await asyncio.sleep(STATUS_PERIOD_S)

    def _publish_status(self) -> None:
        status = self._board.status(
            self._metrics(),
            phase=self._phase,
            backlog=self._handed - self._mapped,
            dropped=self._dropped + self._mapper.refused,
            alive=self._bus.alive,
            now_s=asyncio.get_running_loop().time(),
        )
        self._bus.put(topics.STATUS, status)

    # --- the end -------------------------------------------------------------------------------------------------

    async def _finish(self) -> None:
        """Stop the drones, complete the map, and leave the results in the run folder."""
        self._phase = "finished"
        self._publish_head(self._tick)
        self._publish_phase()
        log.info("mission finished: %s", self._reason)
        loop = asyncio.get_running_loop()
        self._board.activity = "completing the map"
        for update in self._updates:
            update.task.cancel()
        if self._adding:
            await asyncio.wait(self._adding)
        result = await loop.run_in_executor(self._worker, self._mapper.finish)
        self._scores = result.scores or self._scores
        self._board.activity = "writing the results"
        await loop.run_in_executor(self._worker, self._write_results, result, loop.time())
        self._board.activity = self._reason

    def _write_results(self, result: MapUpdate, now_s: float) -> None:
        from ground_station.report import write_report  # plotting is not wanted in memory during the flight

        mesh = result.mesh
        final = self._metrics()
        self._run.record_metrics(final)
        self._run.write_mesh(mesh.vertices, mesh.faces, mesh.colors)
        self._run.finish(
            final,
            floor_baseline=self._mapper.floor_scores(),
            phi_sha256=self._replica.field.sha256,
            wall_time_s=self._board.wall_s(now_s),
            exit_reason=self._reason,
        )
        write_report(self._run.path)


async def run_ground_station(mission: Mission, endpoint: str, folder: Path, *, lockstep: bool) -> None:
    """Be the ground station, and the router, of ``mission``; results go to ``folder``."""
    run = RunFolder(folder, mission)
    try:
        compile_kernels()
        log.info("rehearsing the map")
        rehearse(mission)
        with Journal(folder / "journal") as journal:
            async with connect(endpoint, mission.name, router=True, lossless=lockstep) as bus:
                await GroundStation(mission, bus, run, journal, lockstep=lockstep).run()
    finally:
        run.close()
