"""The ground station's process: keeps phi with the team, turns keyframes into a map, and sends drones back by jumps.

The shell around the parts that do so: it hears, steps with the clock, and says how far it is. Neither the map nor a
drone that is late holds up its event loop (`ground_station.map_feedback`, `protocol.replication`).
"""

from __future__ import annotations

import asyncio
import logging
from contextlib import suppress
from pathlib import Path

from ground_station.journal import JOURNAL_FILE, Journal, open_journal
from ground_station.jump_publisher import JumpPublisher
from ground_station.keyframe_log import KEYFRAMES_FILE, KeyframeLog
from ground_station.map_feedback import MapFeedback
from ground_station.mapper import Mapper, MapUpdate
from ground_station.recovery import Recovery
from ground_station.rehearsal import rehearse
from ground_station.results import Metrics, RunFolder
from ground_station.status import StatusBoard
from protocol import topics
from protocol.bus import Bus, connect
from protocol.clock import clock_of
from protocol.field import VirtualField
from protocol.importance import compile_kernels
from protocol.loop_lag import LoopLag
from protocol.messages import DroneState, JumpHead, MissionPhase, Phase, Tick
from protocol.mission import Mission
from protocol.replication import Integrated, Replication
from protocol.synchroniser import Synchroniser, blocks_of

log = logging.getLogger(__name__)

LOCKSTEP_PATIENCE_S = 20.0
"""Wall time to wait for a live drone's state or a keyframe in lockstep; it runs out only when a process hangs."""
IDLE_TIMEOUT_S = 1.0
METRICS_PERIOD_S = 1.0
"""Mission time between two rows of metrics.csv."""
STATUS_PERIOD_S = 0.5
"""Wall time between two status messages."""
HEAD_EVERY_TICKS = 4
"""How often everybody is told which jumps there are."""


class GroundStation:
    def __init__(
        self, mission: Mission, bus: Bus, run: RunFolder, journal: Journal, mapper: Mapper, *, lockstep: bool
    ) -> None:
        self._mission, self._bus, self._run, self._lockstep = mission, bus, run, lockstep
        self._mapper = mapper
        self._wait_ticks = 0 if lockstep else round(mission.replication.wait_s / mission.tick_s)
        self._replication = Replication(mission, authority=True, epoch=journal.epoch)
        self._board = StatusBoard(mission)
        self._synchroniser = Synchroniser(bus, self._replication, rank=self._board.lost_states)
        self._jumps = JumpPublisher(bus, journal, self._replication)
        self._feedback = MapFeedback(mission, mapper, self._jumps, lockstep=lockstep)
        self._recovery = Recovery(mission, bus, run, self._replication, self._jumps, self._feedback, mapper)
        self._clock = clock_of(mission, bus, lockstep=lockstep, now_s=asyncio.get_running_loop().time)
        self._lag = LoopLag()
        self._phase: Phase = "starting"
        self._reason = ""
        self._tick = 0
        self._promised = 0
        self._outdated = ""
        bus.on(topics.TICK, self._replication.hear_tick)
        bus.on(topics.STATE, self._hear_state, wakes=lockstep)
        bus.on(topics.KEYFRAME, self._feedback.hear)
        bus.serve(topics.BLOCKS, blocks_of(self._replication))
        bus.watch_lives()

    def _hear_state(self, state: DroneState) -> None:
        if self._replication.hear_state(state):
            self._board.hear(state)
            replica = state.replica
            if replica.epoch == self._jumps.epoch and replica.next_jump > self._jumps.next_sequence:
                self._outdated = f"drone {state.drone} has jump {replica.next_jump - 1}, which the journal lacks"

    # --- the mission ---------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """From the first tick until J is low enough, time is up, or the simulator is gone.

        Raises:
            CovreconError: what an earlier life of this process left cannot be gone on with, or the disk refuses it.
        """
        await self._recovery.load()
        self._bus.announce("ground")
        beside = [asyncio.create_task(self._tell()), asyncio.create_task(self._lag.watch())]
        try:
            async with self._synchroniser.running():
                await self._fly()
            await self._recovery.close()
            await self._finish()
        finally:
            self._feedback.close()
            self._jumps.close()
            for task in beside:
                task.cancel()
                with suppress(asyncio.CancelledError):
                    await task
        self._publish_status()

    async def _fly(self) -> None:
        while not self._reason:
            tick = await self._clock.next_tick(IDLE_TIMEOUT_S)
            if tick is not None:
                if self._phase == "starting":
                    self._recovery.begin(tick)
                self._phase = "flying"
                await self._step(tick)
                self._publish_head(tick.tick)
            elif self._clock.is_gone:
                self._reason = "the simulator is gone"

    async def _step(self, tick: Tick) -> None:
        self._tick = tick.tick
        if self._outdated:
            await self._jumps.renew(self._outdated)
            self._outdated = ""
        if self._lockstep and not await self._bus.until(lambda: self._is_complete(tick), LOCKSTEP_PATIENCE_S):
            log.warning("tick %d: going on without all states and keyframes: this run cannot be repeated", tick.tick)
        self._feedback.hand_over(tick.tick)
        await self._feedback.settle(tick.tick)
        steps = self._replication.integrate(tick.tick, self._bus.gone, self._wait_ticks)
        if self._replication.known:
            self._board.activity = ""
            for step in steps:
                self._take_in(step)
        else:
            self._board.activity = "fetching phi from the drones"
            self._recovery.proceed(hopeless=self._board.all_lack_phi(tick.live))
        self._recovery.save_if_due()
        digest = self._replication.take_digest()
        if digest is not None:
            self._bus.put(topics.DIGEST, digest)
        self._board.note_lives(self._bus.alive)

    def _is_complete(self, tick: Tick) -> bool:
        return self._feedback.received >= tick.keyframes and self._replication.is_ready(tick.tick, self._bus.gone)

    def _take_in(self, step: Integrated) -> None:
        """Record a tick that is integrated, and do what is due at it."""
        self._record(step.tick, dict(zip(step.ids, step.poses.tolist(), strict=True)))
        self._feedback.look(step.tick, self._replication.importance)
        self._reason = self._reason or self._end_of(step.tick)

    def _end_of(self, tick: int) -> str:
        """Why the mission is over after this tick; empty while it is not."""
        if self._replication.importance < self._mission.stop_below:
            return f"importance fell below {self._mission.stop_below:g}"
        if (tick + 1) * self._mission.tick_s >= self._mission.duration_s:
            return f"duration of {self._mission.duration_s:g} s reached"
        return ""

    # --- what goes out -------------------------------------------------------------------------------------------

    def _record(self, tick: int, poses: dict[int, list[float]]) -> None:
        self._run.record_tick(tick, tick * self._mission.tick_s, poses, self._board.controls(poses))
        self._board.note_poses(poses)
        if tick % max(1, round(METRICS_PERIOD_S / self._mission.tick_s)) == 0:
            self._run.record_metrics(self._metrics())

    def _metrics(self) -> Metrics:
        return Metrics(
            time_s=self._tick * self._mission.tick_s,
            tick=self._tick,
            importance=self._replication.importance,
            scores=self._feedback.scores,
            jumps=self._jumps.count,
            keyframes=self._feedback.handed,
        )

    def _publish_head(self, tick: int) -> None:
        """Say which jumps there are, and how far ahead no other can come: in lockstep, so far the simulator may fly."""
        done = self._feedback.settled_until(tick)
        finished = bool(self._reason)
        awaited = self._promised <= tick + 1  # the simulator has used up what it was promised
        if not (finished or awaited or done - self._promised >= HEAD_EVERY_TICKS):
            return
        self._promised = done
        head = JumpHead(
            epoch=self._jumps.epoch,
            next_sequence=self._jumps.next_sequence,
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
            self._replication.state(),
            phase=self._phase,
            backlog=self._feedback.backlog,
            dropped=self._feedback.unused,
            refused=self._bus.statistics.unused + self._replication.refused,
            unwritten=self._jumps.unwritten + self._recovery.unwritten + self._run.refused_writes,
            loop_lag_s=self._lag.p99_s,
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
        self._board.activity = "completing the map"
        result = await self._feedback.finish()
        self._board.activity = "writing the results"
        now_s = asyncio.get_running_loop().time()
        await self._feedback.on_worker(lambda: self._write_results(result, now_s))
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
            phi_sha256=self._replication.replica.field.sha256,
            wall_time_s=self._board.wall_s(now_s),
            exit_reason=self._reason,
        )
        write_report(self._run.path)


async def run_ground_station(mission: Mission, endpoint: str, folder: Path, *, lockstep: bool) -> None:
    """Be the ground station of ``mission``; results go to ``folder``."""
    run = RunFolder(folder, mission)
    try:
        compile_kernels()
        log.info("rehearsing the map")
        rehearse(mission)
        journal = open_journal(folder / JOURNAL_FILE)
        with KeyframeLog(folder / KEYFRAMES_FILE) as keyframes:
            mapper = Mapper(mission, VirtualField.of(mission.target), folder, keyframes)
            async with connect(endpoint, mission.name, lossless=lockstep) as bus:
                await GroundStation(mission, bus, run, journal, mapper, lockstep=lockstep).run()
    finally:
        run.close()
