"""One drone's process: reads its vehicle, keeps its replica of phi, decides, flies, and says what it did.

The shell around the pure parts. Per tick: state out, the team's states in, phi advanced to the agreed tick, the
planner's decision, setpoint out (ARCHITECTURE.md, "One tick").
"""

from __future__ import annotations

import logging
import time

import numpy as np

from agents.coverage import CoverageController, Decision
from agents.team import Team
from agents.vehicles.simulated import SimulatedVehicle
from agents.vehicles.vehicle import Telemetry
from agents.watchdog import Watchdog
from protocol import topics
from protocol.bus import Bus, connect
from protocol.clock import SimulatorClock
from protocol.errors import MessageError, NoReply, ProcessError
from protocol.field import VirtualField
from protocol.geometry import Floats
from protocol.importance import ImportanceField, compile_kernels
from protocol.messages import Control, DroneState, Jump, MissionPhase, Tick
from protocol.mission import Mission
from protocol.replica import Replica
from protocol.state_log import StateLog
from protocol.wire import decode

log = logging.getLogger(__name__)

LOCKSTEP_PATIENCE_S = 20.0
"""Wall time to wait for a live neighbour's state or a jump in lockstep; it only runs out when a process hangs. Shorter
than the simulator's, or one that hangs would make all look hung."""
REAL_TIME_PATIENCE_S = 0.01
"""The same in real time: a fifth of a tick. Whoever is later has its decay left out of this replica's tick."""
IDLE_TIMEOUT_S = 0.2
"""How often an agent without ticks looks whether the mission is over; less than any setpoint time-out."""
SHARE_PERIOD_S = 1.0
"""How often |V_i| is counted anew."""
UNLIMITED = 1e9
"""Margin reported where there is no such row; a finite number, because infinities do not travel."""


class Agent:
    def __init__(self, mission: Mission, drone: int, bus: Bus, *, lockstep: bool) -> None:
        self._mission, self._drone, self._bus = mission, drone, bus
        self._patience_s = LOCKSTEP_PATIENCE_S if lockstep else REAL_TIME_PATIENCE_S
        starts = {other.id: other.start for other in mission.drones}
        self._log = StateLog()
        self._team = Team(drone, starts, mission.flight, mission.tick_s)
        self._replica = Replica(ImportanceField(VirtualField.of(mission.target), mission.sensing))
        self._planner = CoverageController(mission, neighbours=len(starts) - 1)
        self._vehicle = SimulatedVehicle(bus, drone, mission.flight)
        self._clock = SimulatorClock(bus, lockstep=lockstep)
        self._watchdog = Watchdog(self._vehicle.stop, self._clock.now_s, mission.flight.setpoint_timeout_s)
        self._cells = float(self._replica.field.field.size)
        self._cells_at = -np.inf
        self._control: Control | None = None
        self._fallbacks = 0
        self._finished = ""
        bus.on(topics.STATE, self._hear_state)
        bus.on(topics.JUMP, self._replica.hear)
        bus.on(topics.PHASE, self._hear_phase)
        bus.watch_lives()

    async def fly(self) -> None:
        """Until the ground station ends the mission.

        Raises:
            ProcessError: the simulator that carried the vehicle is gone.
        """
        self._bus.announce(f"drone/{self._drone}")
        had_simulator = False
        with self._watchdog:
            try:
                while not self._finished:
                    tick = await self._clock.next_tick(IDLE_TIMEOUT_S)
                    if tick is not None:
                        had_simulator = True
                        await self._step(tick)
                    elif had_simulator and "sim" not in self._bus.alive and not self._finished:
                        raise ProcessError(f"drone {self._drone}: the simulator is gone")
            finally:
                self._vehicle.stop()
                self._vehicle.close()
        log.info("drone %d: finished: %s", self._drone, self._finished)

    def _hear_state(self, state: DroneState) -> None:
        if state.drone != self._drone:
            self._log.hear(state)
            self._team.hear(state)

    def _hear_phase(self, order: MissionPhase) -> None:
        if order.phase == "finished":
            self._finished = order.reason
            self._bus.recheck()

    async def _step(self, tick: Tick) -> None:
        if self._clock.backlog:
            self._catch_up(tick)
            return
        telemetry = self._vehicle.telemetry()
        if telemetry is None or not self._is_sound(telemetry, tick):
            log.error("tick %d: no sound telemetry: braking", tick.tick)
            self._vehicle.stop()
            return
        state = self._state_of(telemetry, tick.tick)
        self._log.hear(state)
        self._bus.put(topics.STATE, state, self._drone)

        await self._bus.until(lambda: self._is_complete(tick), self._patience_s)
        await self._fetch_missing_jumps(tick)
        ids, poses = self._log.poses_at(tick.tick, {*tick.live, self._drone})
        row = ids.index(self._drone)
        if tick.time_s - self._cells_at >= SHARE_PERIOD_S:
            self._cells = float(self._replica.field.owned_cells(poses)[row])
            self._cells_at = tick.time_s
        terms = self._replica.advance(tick.tick, poses, self._mission.tick_s, row)
        self._log.forget_before(tick.tick)

        began = time.perf_counter()
        decision = self._planner.decide(
            telemetry.pose, telemetry.velocity, self._team.neighbours(tick.tick), terms, self._cells
        )
        solve_s = time.perf_counter() - began
        sent = self._vehicle.send(tick.tick, decision.velocity)
        self._watchdog.feed()
        self._report(tick.tick, decision, sent, solve_s)

    def _catch_up(self, tick: Tick) -> None:
        """A tick that is over already: phi is integrated with what was heard of it, and nothing is decided."""
        _, poses = self._log.poses_at(tick.tick, tick.live)
        self._replica.advance(tick.tick, poses, self._mission.tick_s)

    def _is_sound(self, telemetry: Telemetry, tick: Tick) -> bool:
        """Alive, fresh and valid, in simulation too."""
        fresh = abs(tick.time_s - telemetry.stamp_s) <= topics.TICK.max_age_s
        return fresh and bool(np.isfinite(telemetry.pose).all() and np.isfinite(telemetry.velocity).all())

    def _is_complete(self, tick: Tick) -> bool:
        """Whether everybody alive has said where it is, and all jumps due are in."""
        waited_for = [drone for drone in tick.live if f"drone/{drone}" in self._bus.alive]
        return bool(self._finished) or (
            self._log.has_all(tick.tick, waited_for) and self._replica.next_sequence >= tick.next_jump
        )

    async def _fetch_missing_jumps(self, tick: Tick) -> None:
        """Fill a gap from the journal: one that a held jump shows, or that the clock's head tells of."""
        first, last = self._replica.next_sequence, tick.next_jump
        if self._replica.gap is not None:
            last = max(last, self._replica.gap[1])
        if first >= last or self._finished:
            return
        try:
            page = await self._bus.ask(topics.JOURNAL, f"from={first};to={last}")
        except NoReply as error:
            log.warning("jumps %d to %d are missing: %s", first, last, error)
            return
        try:
            for encoded in page.jumps:
                self._replica.hear(decode(Jump, encoded))
        except MessageError as error:
            log.warning("a jump of the journal cannot be read: %s", error)
        log.info("fetched jumps from %d on, next is %d", first, self._replica.next_sequence)

    def _state_of(self, telemetry: Telemetry, tick: int) -> DroneState:
        braking = self._control is not None and self._control.outcome != "solved"
        return DroneState(
            drone=self._drone,
            tick=tick,
            pose=tuple(telemetry.pose.tolist()),
            velocity=tuple(telemetry.velocity.tolist()),
            battery=telemetry.battery,
            mode="braking" if braking else "flying",
            importance=self._replica.field.importance,
            control=self._control,
        )

    def _report(self, tick: int, decision: Decision, sent: Floats, solve_s: float) -> None:
        if decision.outcome != "solved":
            self._fallbacks += 1
            log.warning("tick %d: solver says %s: braking", tick, decision.outcome)
        rows = decision.rows
        self._control = Control(
            tick=tick,
            outcome=decision.outcome,
            velocity=tuple(sent.tolist()),
            slack=decision.slack,
            sampling=decision.sampling,
            solve_s=solve_s,
            separation_margin_m2=rows.margin("separation", UNLIMITED),
            region_margin_m=rows.margin("region", UNLIMITED),
            pitch_margin_rad2=rows.margin("pitch", UNLIMITED),
            active=decision.active,
            fallbacks=self._fallbacks,
            refused=sum(self._bus.statistics.refused.values()) + self._replica.refused,
        )


async def run_agent(mission: Mission, drone: int, endpoint: str, *, lockstep: bool) -> None:
    """Fly one drone of ``mission`` until it ends."""
    compile_kernels()
    CoverageController(mission, neighbours=1).rehearse()
    async with connect(endpoint, mission.name, lossless=lockstep) as bus:
        await Agent(mission, drone, bus, lockstep=lockstep).fly()
