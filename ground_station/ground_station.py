"""The ground station's process: keeps phi with the team, turns keyframes into a map, and sends drones back by jumps.

The shell around the parts that do so: it hears, steps with the clock, and says how far it is. Neither the map nor a
drone that is late holds up its event loop (`ground_station.map_feedback`, `protocol.replication`).
"""

from __future__ import annotations

import asyncio
import logging
from contextlib import suppress
from functools import partial
from pathlib import Path

from prometheus_client import CollectorRegistry

from ground_station.command_log import COMMANDS_FILE, CommandLog
from ground_station.command_service import CommandService
from ground_station.external_map import ExternalMap
from ground_station.ground_metrics import GroundMetrics, MapLoad
from ground_station.journal import JOURNAL_FILE, Journal, open_journal
from ground_station.jump_publisher import JumpPublisher
from ground_station.keyframe_log import KEYFRAMES_FILE, KeyframeLog
from ground_station.map_feedback import MapFeedback
from ground_station.map_service import MapService
from ground_station.mapper import Mapper, MapUpdate
from ground_station.obstacle_publisher import ObstaclePublisher
from ground_station.pose_errors import PoseErrors
from ground_station.recording.recorder import RECORDING_FILE, Recorder, recording_path
from ground_station.recovery import Recovery
from ground_station.rehearsal import rehearse
from ground_station.results import METRICS_PERIOD_S, Metrics, RunFolder
from ground_station.status import StatusBoard
from protocol import topics
from protocol.bus import Bus, connect
from protocol.clock import clock_of
from protocol.field import VirtualField
from protocol.importance import compile_kernels
from protocol.loop_lag import LoopLag
from protocol.messages import DroneState, JumpHead, MissionPhase, Phase, Tick
from protocol.metrics_endpoint import MetricsEndpoint
from protocol.mission import Mission
from protocol.news import News
from protocol.replication import Integrated, Replication
from protocol.separation import SIGMAS
from protocol.session import Link
from protocol.synchroniser import Synchroniser, blocks_of

log = logging.getLogger(__name__)

LOCKSTEP_PATIENCE_S = 20.0
"""Wall time to wait for a live drone's state or a keyframe in lockstep; it runs out only when a process hangs."""
IDLE_TIMEOUT_S = 1.0
STATUS_PERIOD_S = 0.5
"""Wall time between two status messages."""
HOMECOMING_S = 180.0
"""How long the drones are watched on their way home, wall time."""
HEAD_EVERY_TICKS = 4
"""How often everybody is told which jumps there are."""


class GroundStation:
    def __init__(
        self,
        mission: Mission,
        bus: Bus,
        run: RunFolder,
        journal: Journal,
        commands: CommandLog,
        mapper: Mapper,
        recorder: Recorder,
        *,
        lockstep: bool,
        metrics: GroundMetrics | None = None,
        external: ExternalMap | None = None,
    ) -> None:
        self._mission, self._bus, self._run, self._lockstep = mission, bus, run, lockstep
        self._recorder = recorder
        self._figures = metrics or GroundMetrics(CollectorRegistry())
        self._mapper = mapper
        self._wait_ticks = 0 if lockstep else round(mission.replication.wait_s / mission.tick_s)
        self._replication = Replication(mission, authority=True, epoch=journal.epoch)
        keep = partial(recorder.heard, topics.GROUND_EVENT, tick=0)  # an event has its own tick
        self._news = News(bus, topics.GROUND_EVENT, "ground", keep=keep)
        self._board = StatusBoard(mission, self._news.tell)
        self._synchroniser = Synchroniser(bus, self._replication, rank=self._board.lost_states)
        self._jumps = JumpPublisher(bus, journal, self._replication)
        self._feedback = MapFeedback(mission, mapper, self._jumps, recorder, self._news.tell, lockstep=lockstep)
        self._obstacles = None
        if mission.flight.obstacles.enabled:
            self._obstacles = ObstaclePublisher(mission, bus, mapper, self._feedback, recorder, lockstep=lockstep)
        self._recovery = Recovery(mission, bus, run, self._replication, self._jumps, self._feedback, mapper)
        self._clock = clock_of(mission, bus, lockstep=lockstep, now_s=asyncio.get_running_loop().time)
        self._lag = LoopLag()
        self._pose_errors = PoseErrors()
        judged = mission.vehicles.kind == "simulated" and mission.simulation.scene
        self._contacts = dict.fromkeys((drone.id for drone in mission.drones), 0) if judged else {}
        self._commands = CommandService(mission, bus, commands, phase=lambda: self._phase, changed=self._obey)
        waits = mission.start == "on_command" and not self._commands.started
        self._phase: Phase = "waiting" if waits else "starting"
        self._reason = ""
        self._tick = 0
        self._promised = 0
        self._outdated = ""
        bus.on_foreign(partial(self._news.tell, "error", "link"))
        bus.on(topics.TICK, self._replication.hear_tick)
        bus.on(topics.STATE, self._hear_state, wakes=lockstep)
        bus.on(topics.KEYFRAME, self._feedback.hear)
        bus.on(topics.EVENT, partial(recorder.heard, topics.EVENT, tick=0))
        bus.serve(topics.MAP, MapService(self._feedback).answer)
        bus.serve(topics.BLOCKS, blocks_of(self._replication))
        if external is not None:
            external.join(self._news.tell, lambda: "mapper" in bus.alive)
            bus.on(topics.EXTERNAL_MESH, external.hear)
            bus.serve(topics.MAP_KEYFRAMES, external.answer)
        bus.watch_lives()

    def _hear_state(self, state: DroneState) -> None:
        if self._replication.hear_state(state):
            self._recorder.heard(topics.STATE, state, state.tick)
            self._board.hear(state)
            self._figures.hear_state(state)
            self._commands.hear(state)
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
            if self._obstacles is not None:
                self._obstacles.close()
            await self._finish()
            await self._see_them_home()
            await self._report()
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
                if self._phase != "flying":
                    self._recovery.begin(tick)
                self._phase = "flying"
                await self._step(tick)
                self._publish_head(tick.tick)
            elif self._clock.is_gone:
                self._reason = "the simulator is gone"

    async def _step(self, tick: Tick) -> None:
        self._tick = self._news.tick = tick.tick
        self._pose_errors.hear(tick)
        self._note_contacts(tick)
        if self._outdated:
            self._news.tell("error", "phi", f"{self._outdated}: a new epoch begins")
            await self._jumps.renew(self._outdated)
            self._outdated = ""
        if self._lockstep and not await self._bus.until(lambda: self._is_complete(tick), LOCKSTEP_PATIENCE_S):
            self._news.tell("warning", "link", "going on without all states and keyframes: this run cannot be repeated")
        self._feedback.hand_over(tick.tick)
        await self._feedback.settle(tick.tick)
        if self._obstacles is not None:
            self._obstacles.look(tick.tick)
            await self._obstacles.settle(tick.tick)
        steps = self._replication.integrate(tick.tick, self._bus.gone, self._wait_ticks)
        if self._replication.known:
            self._board.activity = ""
            for step in steps:  # all before any look at the map: its J is that after the last of them
                self._recorder.integrated(step)
            for step in steps:
                self._take_in(step)
        else:
            self._board.activity = "fetching phi from the drones"
            self._recovery.proceed(hopeless=self._board.all_lack_phi(tick.live))
        self._recovery.save_if_due()
        for digest in self._replication.take_digests():
            self._bus.put(topics.DIGEST, digest)
        self._board.note_lives(self._bus.alive)

    def _note_contacts(self, tick: Tick) -> None:
        for drone, count in tick.contacts:
            if count > self._contacts.get(drone, 0):
                self._news.tell("error", "vehicle", f"drone {drone} touches the scene")
            self._contacts[drone] = count

    def _is_complete(self, tick: Tick) -> bool:
        return self._feedback.received >= tick.keyframes and self._replication.is_ready(tick.tick, self._bus.gone)

    def _take_in(self, step: Integrated) -> None:
        """Record a tick that is integrated, and do what is due at it."""
        self._recorder.phi(step.tick, self._replication.replica.field.phi)
        flown = dict(zip(step.ids, step.poses.tolist(), strict=True))
        self._record(step.tick, flown | {drone: pose.tolist() for drone, pose in step.aground.items()})
        self._feedback.look(step.tick, self._replication.importance)
        self._reason = self._reason or self._end_of(step.tick)

    def _end_of(self, tick: int) -> str:
        """Why the mission is over after this tick; empty while it is not."""
        if self._replication.importance < self._mission.stop_below:
            return f"importance fell below {self._mission.stop_below:g}"
        if (tick + 1) * self._mission.tick_s >= self._mission.duration_s:
            return f"duration of {self._mission.duration_s:g} s reached"
        if self._board.all_landed:
            return "all drones have landed"
        return ""

    # --- what goes out -------------------------------------------------------------------------------------------

    def _record(self, tick: int, poses: dict[int, list[float]]) -> None:
        states, truth = self._board.states(poses), self._pose_errors.truth(tick)
        allowed_m = {drone: SIGMAS * state.position_sd_m for drone, state in states.items()}
        self._pose_errors.note(tick, poses, allowed_m)
        self._run.record_tick(tick, tick * self._mission.tick_s, poses, states, truth)
        self._board.note_poses(truth or poses)
        if tick % max(1, round(METRICS_PERIOD_S / self._mission.tick_s)) == 0:
            metrics = self._metrics()
            self._run.record_metrics(metrics)
            self._recorder.metrics(metrics)

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
        phase = MissionPhase(phase=self._phase, reason=self._reason, orders=self._commands.orders)
        self._bus.put(topics.PHASE, phase)
        self._recorder.heard(topics.PHASE, phase, self._tick)

    def _obey(self, command: str) -> None:
        """Of a command, what is not the drones' own: they hear of theirs at once, and twice a second from then on."""
        self._news.tell("warning", "command", command)
        if self._commands.started and self._phase == "waiting":
            self._phase = "starting"
        if self._commands.aborted:
            self._reason = self._reason or "aborted by an operator"
        self._publish_phase()

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
        self._recorder.heard(topics.STATUS, status, status.tick)
        self._figures.hear_status(
            status,
            MapLoad(self._feedback.backlog, self._feedback.passed_over, self._mapper.memory_bytes),
            recording=self._recorder.statistics(),
        )

    # --- the end -------------------------------------------------------------------------------------------------

    async def _finish(self) -> None:
        """Stop the drones, complete the map, and leave the results in the run folder."""
        self._phase = "finished"
        self._publish_head(self._tick)
        self._publish_phase()
        self._news.tell("info", "mission", f"finished: {self._reason}")
        self._board.activity = "completing the map"
        result = await self._feedback.finish()
        self._board.activity = "writing the results"
        now_s = asyncio.get_running_loop().time()
        await self._feedback.on_worker(lambda: self._write_results(result, now_s))
        self._board.activity = self._reason

    async def _see_them_home(self) -> None:
        """Vehicles that fly by themselves come down after the mission; until then they are watched and commanded."""
        if self._mission.vehicles.kind == "simulated":
            return
        drones = {f"drone/{drone.id}" for drone in self._mission.drones}
        loop = asyncio.get_running_loop()
        deadline = loop.time() + HOMECOMING_S
        while loop.time() < deadline and not self._board.all_landed and drones & self._bus.alive:
            self._board.activity = f"{self._reason}; the drones come down"
            await asyncio.sleep(STATUS_PERIOD_S)
            self._bus.poll()
        self._board.activity = self._reason

    def _write_results(self, result: MapUpdate, now_s: float) -> None:
        mesh = result.mesh
        final = self._metrics()
        self._run.record_metrics(final)
        self._run.write_mesh(mesh.vertices, mesh.faces, mesh.colors)
        field = self._replication.replica.field
        self._run.write_phi(field.phi, field.field)
        summary = self._run.finish(
            final,
            floor_baseline=self._mapper.floor_scores(),
            phi_sha256=field.sha256,
            wall_time_s=self._board.wall_s(now_s),
            exit_reason=self._reason,
            feedback_update_s=self._mapper.feedback_update_s,
            pose_errors=self._pose_errors.figures,
            unlocated=self._mapper.unlocated,
            contacts=self._contacts or None,
        )
        self._recorder.metrics(final)
        self._recorder.finished(summary, mesh)

    async def _report(self) -> None:
        """The page that people open, made from what is in the folder, the whole recording too."""
        from ground_station.report import write_report  # plotting is not wanted in memory during the flight

        await asyncio.to_thread(self._recorder.close)
        if self._mission.recording.report:
            self._board.activity = "writing the report"
            await self._feedback.on_worker(lambda: write_report(self._run.path))
        self._board.activity = self._reason


def _recorder(mission: Mission, folder: Path, *, lockstep: bool) -> Recorder:
    settings, path = mission.recording, recording_path(folder)
    return Recorder(
        path if settings.enabled else None,
        mission,
        lossless=lockstep,
        foxglove_port=settings.foxglove_port or None,
        resumed=path.name != RECORDING_FILE,
    )


async def run_ground_station(mission: Mission, link: Link, folder: Path, *, lockstep: bool) -> None:
    """Be the ground station of ``mission``; results go to ``folder``."""
    run = RunFolder(folder, mission)
    served = MetricsEndpoint(mission, "ground")
    try:
        compile_kernels()
        log.info("rehearsing the map")
        rehearse(mission)
        journal = open_journal(folder / JOURNAL_FILE)
        with KeyframeLog(folder / KEYFRAMES_FILE) as keyframes, CommandLog(folder / COMMANDS_FILE) as commands:
            external = None
            if mission.reconstruction.backend == "external":
                external = ExternalMap(mission, keyframes, journal.epoch, lockstep=lockstep)
            mapper = Mapper(mission, VirtualField.of(mission.target), folder, keyframes, external)
            async with connect(link, mission.name, lossless=lockstep) as bus:
                with _recorder(mission, folder, lockstep=lockstep) as recorder:
                    await GroundStation(
                        mission,
                        bus,
                        run,
                        journal,
                        commands,
                        mapper,
                        recorder,
                        lockstep=lockstep,
                        metrics=GroundMetrics(served.registry),
                        external=external,
                    ).run()
    finally:
        served.close()
        run.close()
