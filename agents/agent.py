"""One drone's process: reads its vehicle, keeps its replica of phi, decides, flies, and says what it did.

The shell around the pure parts. Per tick: state out, the team's states in, phi advanced as far as it can be, the
planner's decision, setpoint out (ARCHITECTURE.md, "One tick"). In real time nobody is waited for.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Protocol

import numpy as np

from agents.coverage import CoverageController, Decision
from agents.team import Team
from agents.vehicles.simulated import SimulatedVehicle
from agents.vehicles.vehicle import Telemetry
from agents.watchdog import Watchdog
from protocol import topics
from protocol.bus import Bus, connect
from protocol.clock import SimulatorClock
from protocol.errors import ProcessError
from protocol.geometry import Floats
from protocol.importance import SamplingTerms, compile_kernels
from protocol.messages import Control, DroneState, JumpHead, MissionPhase, Mode, Tick, Vector5
from protocol.mission import Mission
from protocol.replication import Replication
from protocol.synchroniser import Synchroniser, blocks_of

log = logging.getLogger(__name__)

LOCKSTEP_PATIENCE_S = 20.0
"""Wall time to wait for a live neighbour's state or a jump in lockstep; it only runs out when a process hangs. Shorter
than the simulator's, or one that hangs would make all look hung."""
IDLE_TIMEOUT_S = 0.2
"""How often an agent without ticks looks whether the mission is over; less than any setpoint time-out."""
SHARE_PERIOD_S = 1.0
"""How often |V_i| is counted anew."""
EARLIER_STATES, PASSED_STATES = 3, 8
"""States repeated in each message: with one message in ten lost, one state in ten thousand is. After ticks that passed
by without one, more."""
DESCENT_MPS = 0.3
"""Of a drone that lands because the ground station stayed away."""
TOUCHDOWN_M = 0.1
"""Height above the flight region's floor from which the vehicle lands by itself."""
UNLIMITED = 1e9
"""Margin reported where there is no such row; a finite number, because infinities do not travel."""


class Guard(AbstractContextManager["Guard"], Protocol):
    """What `agents.watchdog.Watchdog` is to the agent."""

    def feed(self) -> None: ...


class Agent:
    def __init__(
        self,
        mission: Mission,
        drone: int,
        bus: Bus,
        *,
        lockstep: bool,
        now_s: Callable[[], float] = time.monotonic,
        watchdog: Callable[[Callable[[], None], Callable[[], float], float], Guard] = Watchdog,
    ) -> None:
        """``now_s``: monotonic seconds, callable from any thread, by which silence is judged in real time."""
        self._mission, self._drone, self._bus, self._lockstep = mission, drone, bus, lockstep
        self._now_s = now_s
        starts = {other.id: other.start for other in mission.drones}
        self._wait_ticks = 0 if lockstep else round(mission.replication.wait_s / mission.tick_s)
        self._team = Team(drone, starts, mission.flight, mission.tick_s)
        self._replication = Replication(mission, drone)
        self._synchroniser = Synchroniser(bus, self._replication, drone)
        self._planner = CoverageController(mission, neighbours=len(starts) - 1)
        self._vehicle = SimulatedVehicle(bus, drone, mission.flight, mission.tick_s)
        self._clock = SimulatorClock(bus, lockstep=lockstep, now_s=now_s)
        self._watchdog = watchdog(self._vehicle.stop, self._clock.now_s, mission.flight.setpoint_timeout_s)
        self._earlier: deque[tuple[int, Vector5]] = deque(maxlen=PASSED_STATES)
        self._published = -1
        self._tick = 0
        self._cells = float(self._replication.replica.field.field.size)
        self._cells_at = -np.inf
        self._control: Control | None = None
        self._fallbacks = 0
        self._ground_heard_s = now_s()
        self._landing = False
        self._finished = ""
        bus.on(topics.TICK, self._replication.hear_tick)
        bus.on(topics.STATE, self._hear_state, wakes=lockstep)
        bus.on(topics.JUMP, self._replication.hear_jump)
        bus.on(topics.HEAD, self._hear_head)
        bus.on(topics.DIGEST, self._replication.hear_digest)
        bus.on(topics.PHASE, self._hear_phase)
        bus.serve(topics.DRONE_BLOCKS, blocks_of(self._replication), drone)
        bus.watch_lives()

    async def fly(self) -> None:
        """Until the ground station ends the mission.

        Raises:
            ProcessError: the simulator that carried the vehicle is gone.
        """
        self._bus.announce(f"drone/{self._drone}")
        async with self._synchroniser.running():
            with self._watchdog:
                try:
                    while not self._finished:
                        tick = await self._clock.next_tick(IDLE_TIMEOUT_S)
                        if tick is not None:
                            await self._step(tick)
                        elif self._clock.is_gone and not self._finished:
                            raise ProcessError(f"drone {self._drone}: the simulator is gone")
                finally:
                    self._vehicle.stop()
                    self._vehicle.close()
        log.info("drone %d: finished: %s", self._drone, self._finished)

    def _hear_state(self, state: DroneState) -> None:
        if state.drone != self._drone:
            self._replication.hear_state(state)
            self._team.hear(state, self._tick)  # also one whose state phi cannot use is an obstacle

    def _hear_head(self, head: JumpHead) -> None:
        self._ground_heard_s = self._now_s()
        self._replication.hear_head(head)

    def _hear_phase(self, order: MissionPhase) -> None:
        self._ground_heard_s = self._now_s()
        if order.phase == "finished":
            self._finished = order.reason
            self._bus.recheck()

    # --- one tick ------------------------------------------------------------------------------------------------

    async def _step(self, tick: Tick) -> None:
        self._tick = tick.tick
        if self._clock.backlog:  # it is over already: phi catches up with it later, and nothing is decided
            self._earlier.extend((tick.tick, own.pose) for own in tick.vehicles if own.drone == self._drone)
            return
        telemetry = self._vehicle.telemetry()
        if telemetry is None or not self._is_sound(telemetry, tick):
            log.error("tick %d: no sound telemetry: braking", tick.tick)
            self._vehicle.stop()
            return
        mode = self._mode()
        self._publish(telemetry, tick.tick, mode)
        terms = await self._advance(tick)

        began = time.perf_counter()
        decision = self._decide(telemetry, tick, mode, terms)
        solve_s = time.perf_counter() - began
        sent = self._vehicle.send(tick.tick, decision.velocity)
        self._watchdog.feed()
        if self._landing:
            self._vehicle.land()
        self._report(tick.tick, decision, sent, solve_s)

    def _publish(self, telemetry: Telemetry, tick: int, mode: Mode) -> None:
        state = self._state_of(telemetry, tick, mode)
        self._replication.hear_state(state)
        self._bus.put(topics.STATE, state, self._drone)
        self._published = tick
        if not self._lockstep:  # where nothing is lost, nothing need be repeated
            self._earlier.append((tick, state.pose))

    async def _advance(self, tick: Tick) -> SamplingTerms:
        """Bring phi forward; the sampling terms at the own pose."""
        ready = self._replication.is_ready
        if self._lockstep:
            await self._bus.until(lambda: bool(self._finished) or ready(tick.tick, self._bus.gone), LOCKSTEP_PATIENCE_S)
        steps = self._replication.integrate(tick.tick, self._bus.gone, self._wait_ticks)
        if steps and steps[-1].terms is not None:
            return steps[-1].terms
        return self._replication.terms()

    def _decide(self, telemetry: Telemetry, tick: Tick, mode: Mode, terms: SamplingTerms) -> Decision:
        neighbours = self._team.neighbours(tick.tick, telemetry.delay_s)
        if mode in ("joining", "holding"):
            return self._planner.hold(telemetry.pose, telemetry.velocity, neighbours)
        if mode == "landing":
            floor = self._mission.flight.lower_m[2]
            self._landing = self._landing or telemetry.pose[2] - floor < TOUCHDOWN_M
            return self._planner.hold(telemetry.pose, telemetry.velocity, neighbours, DESCENT_MPS)
        if tick.time_s - self._cells_at >= SHARE_PERIOD_S:
            row, poses = self._replication.newest()
            self._cells = float(self._replication.replica.field.owned_cells(poses)[row])
            self._cells_at = tick.time_s
        return self._planner.decide(telemetry.pose, telemetry.velocity, neighbours, terms, self._cells)

    def _mode(self) -> Mode:
        if self._landing:
            return "landing"
        if not self._replication.known:
            return "joining"
        away_s = self._now_s() - self._ground_heard_s
        if not self._lockstep and away_s > self._mission.replication.ground_patience_s:
            return "holding" if self._mission.replication.ground_lost == "hold" else "landing"
        return "braking" if self._control is not None and self._control.outcome != "solved" else "flying"

    def _is_sound(self, telemetry: Telemetry, tick: Tick) -> bool:
        """Alive, fresh and valid, in simulation too."""
        fresh = abs(tick.time_s - telemetry.stamp_s) <= topics.TICK.max_age_s
        return fresh and bool(np.isfinite(telemetry.pose).all() and np.isfinite(telemetry.velocity).all())

    def _state_of(self, telemetry: Telemetry, tick: int, mode: Mode) -> DroneState:
        return DroneState(
            drone=self._drone,
            tick=tick,
            pose=tuple(telemetry.pose.tolist()),
            velocity=tuple(telemetry.velocity.tolist()),
            battery=telemetry.battery,
            mode=mode,
            earlier=tuple(
                entry for entry in self._earlier if entry[0] > min(self._published, tick - 1 - EARLIER_STATES)
            ),
            importance=self._replication.importance,
            replica=self._replication.state(),
            control=self._control,
        )

    def _report(self, tick: int, decision: Decision, sent: Floats, solve_s: float) -> None:
        if decision.outcome != "solved":
            self._fallbacks += 1
            if self._control is None or self._control.outcome != decision.outcome:
                log.warning("tick %d: solver says %s: braking until it finds a way", tick, decision.outcome)
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
            refused=self._bus.statistics.unused + self._replication.refused,
        )


async def run_agent(mission: Mission, drone: int, endpoint: str, *, lockstep: bool) -> None:
    """Fly one drone of ``mission`` until it ends."""
    compile_kernels()
    CoverageController(mission, neighbours=1).rehearse()
    async with connect(endpoint, mission.name, lossless=lockstep) as bus:
        await Agent(mission, drone, bus, lockstep=lockstep).fly()
