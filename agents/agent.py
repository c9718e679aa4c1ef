"""One drone's process: reads its vehicle, keeps its replica of phi, decides, flies, and says what it did.

The shell around the pure parts. Per tick: state out, the team's states in, phi advanced as far as it can be, the
planner's decision, setpoint out (ARCHITECTURE.md, "One tick"). In real time nobody is waited for.
"""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from typing import Protocol

import numpy as np
from prometheus_client import CollectorRegistry

from agents.agent_metrics import AgentMetrics
from agents.barriers import Neighbour, predicted_pose
from agents.cameras.choice import make_feed
from agents.energy import Reserve
from agents.hearing import Hearing
from agents.homing import Homecoming
from agents.localization.choice import make_pose_source
from agents.obstacle_watch import ObstacleWatch
from agents.obstacles import Obstacles
from agents.orders import Orders
from agents.planners.choice import make_planner
from agents.planners.planner import Decision
from agents.policies import Order
from agents.swap import Swap
from agents.team import Team
from agents.vehicles.choice import make_vehicle
from agents.vehicles.vehicle import Condition, Telemetry
from agents.watchdog import Watchdog
from agents.way_up import WayUp
from protocol import topics
from protocol.bus import Bus, connect
from protocol.clock import clock_of
from protocol.errors import ProcessError
from protocol.geometry import Floats
from protocol.importance import SamplingTerms, compile_kernels
from protocol.messages import (
    UNLIMITED,
    Control,
    DroneOrder,
    DroneState,
    EventLevel,
    JumpHead,
    MissionPhase,
    Mode,
    Tick,
    Vector5,
)
from protocol.metrics_endpoint import MetricsEndpoint
from protocol.mission import Mission
from protocol.news import News
from protocol.replication import Replication
from protocol.session import Link
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
HOLDS_AFTER_S = 1.5
"""A vehicle that its agent does not hear stops within this: it is told to, or takes the link for lost (PX4's
COM_OF_LOSS_T of 1 s, and the way until it stands)."""
LOST_S = 60.0
"""After the mission, an agent speaks for a vehicle that is lost until the others are down."""
LANDED_TICKS = 20
"""How often a drone says that it stands on the ground before its process ends: the others need not wonder."""


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
        watchdog: Callable[..., Guard] = Watchdog,
        metrics: AgentMetrics | None = None,
    ) -> None:
        """``now_s``: monotonic seconds, callable from any thread, by which silence is judged in real time."""
        self._mission, self._drone, self._bus, self._lockstep = mission, drone, bus, lockstep
        self._now_s = now_s
        self._metrics = metrics or AgentMetrics(CollectorRegistry())
        starts = {other.id: other.start for other in mission.drones}
        self._wait_ticks = 0 if lockstep else round(mission.replication.wait_s / mission.tick_s)
        self._team = Team(drone, starts, mission.flight, mission.tick_s)
        self._replication = Replication(mission, drone)
        self._synchroniser = Synchroniser(bus, self._replication, drone)
        self._planner = make_planner(mission, drone)
        self._watch = ObstacleWatch(mission, self._planner, now_s, lockstep=lockstep)
        self._homecoming = Homecoming(mission, drone, self._planner, self._watch.obstacles)
        self._clock = clock_of(mission, bus, lockstep=lockstep, now_s=now_s)
        self._news = News(bus, topics.EVENT, f"drone/{drone}", drone)
        self._hearing = Hearing(mission, drone, bus, self._replication, self._team, self._news.tell, lockstep=lockstep)
        self._vehicle = make_vehicle(mission, drone, bus, now_s=self._clock.now_s, events=self._note_event)
        self._poses = make_pose_source(
            mission,
            drone,
            bus,
            lockstep=lockstep,
            now_s=self._clock.now_s,
            aid=self._vehicle.aid,
            others=self._team.places,
            tell=self._news.tell,
        )
        self._orders = Orders(mission, self._clock.now_s, self._news.tell)
        self._operator = DroneOrder(drone=drone, action="fly", number=0)
        self._reserve = Reserve(mission, drone, self._watch.obstacles)
        self._swap = Swap(mission, drone, self._news.tell)
        self._climb_m = 0.0
        self._feed = make_feed(mission, drone, bus, now_s=self._clock.now_s)
        self._watchdog = watchdog(
            self._vehicle.stop,
            self._clock.now_s,
            mission.flight.setpoint_timeout_s,
            give_up=self._vehicle.hold if mission.vehicles.setpoint_lost == "hold" else self._vehicle.land,
            give_up_after_s=mission.vehicles.setpoint_lost_s,
        )
        self._earlier: deque[tuple[int, Vector5]] = deque(maxlen=PASSED_STATES)
        self._published = -1
        self._cells = float(self._replication.replica.field.field.size)
        self._cells_at = -np.inf
        self._control: Control | None = None
        self._fallbacks = 0
        self._ground_heard_s = now_s()
        self._landed_told = 0
        self._blind = False
        self._finished_s = math.inf
        self._finished = ""
        self.mode: Mode = "starting"
        """As its newest state says."""
        bus.on_foreign(partial(self._news.tell, "error", "link"))
        bus.on(topics.TICK, self._replication.hear_tick)
        bus.on(topics.JUMP, self._replication.hear_jump)
        bus.on(topics.HEAD, self._hear_head)
        bus.on(topics.DIGEST, self._replication.hear_digest)
        bus.on(topics.PHASE, self._hear_phase)
        self._watch.listen(bus)
        bus.serve(topics.DRONE_BLOCKS, blocks_of(self._replication), drone)
        bus.watch_lives()

    async def fly(self) -> None:
        """From the vehicle's checks until the ground station has ended the mission and the vehicle is down.

        Raises:
            VehicleError: it cannot fly.
            ProcessError: the simulator that carried the vehicle is gone.
        """
        try:
            self._poses.prepare()
            await self._vehicle.prepare()
            if self._feed is not None:
                self._feed.start()
            self._bus.announce(f"drone/{self._drone}")
            async with self._synchroniser.running():
                with self._watchdog:
                    try:
                        await self._follow_clock()
                    finally:
                        self._vehicle.leave(hold=self._orders.stays_up)
        finally:
            if self._feed is not None:
                await asyncio.to_thread(self._feed.close)
            self._poses.close()
            self._vehicle.close()
        log.info("drone %d: finished: %s", self._drone, self._finished)

    async def _follow_clock(self) -> None:
        while not self._is_over():
            tick = await self._clock.next_tick(IDLE_TIMEOUT_S)
            if tick is not None:
                await self._step(tick)
            elif self._clock.is_gone and not self._finished:
                raise ProcessError(f"drone {self._drone}: the simulator is gone")

    def _is_over(self) -> bool:
        """The mission, and for a vehicle that has to be brought down, its flight."""
        if not self._finished:
            return False
        if self._mission.vehicles.kind == "simulated":
            return True
        authority = self._vehicle.condition().authority
        if authority == "landed":
            return self._landed_told >= LANDED_TICKS
        if authority == "lost":
            return self._clock.now_s() - self._finished_s > LOST_S
        return authority not in ("starting", "ours", "landing") or self._orders.stays_up

    def _note_event(self, level: str, text: str) -> None:
        known: dict[str, EventLevel] = {"warning": "warning", "error": "error", "critical": "error"}
        self._news.tell(known.get(level.lower(), "info"), "vehicle", text)

    def _hear_head(self, head: JumpHead) -> None:
        self._ground_heard_s = self._now_s()
        self._replication.hear_head(head)

    def _hear_phase(self, order: MissionPhase) -> None:
        self._ground_heard_s = self._now_s()
        for wanted in order.orders:
            if wanted.drone == self._drone and wanted.number >= self._operator.number:
                self._operator = wanted
        if order.phase == "finished":
            self._finished = order.reason
            self._finished_s = min(self._finished_s, self._clock.now_s())
            self._bus.recheck()

    # --- one tick ------------------------------------------------------------------------------------------------

    async def _step(self, tick: Tick) -> None:
        self._hearing.tick = self._news.tick = tick.tick
        if self._clock.backlog:  # it is over already: phi catches up with it later, and nothing is decided
            self._earlier.extend((tick.tick, own.pose) for own in tick.vehicles if own.drone == self._drone)
            return
        self._hearing.look()
        telemetry = await self._poses.locate(tick.tick, self._vehicle.telemetry())
        condition = self._vehicle.condition()
        order = self._give_orders(telemetry, condition)
        if telemetry is not None and self._swap.is_done(telemetry, condition.authority, self._operator):
            condition = self._fly_again(telemetry, condition)
        if telemetry is not None and condition.authority == "landed":
            telemetry = self._stands(telemetry)
        may_start = condition.authority == "ready" and not self._finished and order.action == "wait"
        if may_start and self._way_up_is_free(telemetry, tick.tick):
            self._vehicle.take_off()  # the first tick is the order to start
        if telemetry is None or not self._is_sound(telemetry, condition):
            self._step_blindly(telemetry, tick, order)
            return
        if self._blind:
            self._news.tell("info", "vehicle", "telemetry is sound again")
            self._blind = False
        self.mode = mode = self._mode(condition, order)
        self._climb_m = self._swap.climb_m(telemetry, condition.authority)
        self._publish(telemetry, tick.tick, mode)
        if self._feed is not None and condition.authority == "ours":
            self._feed.note_pose(telemetry.stamp_s, tick.tick, telemetry.pose, telemetry.rotation, telemetry.deviations)
        terms = await self._advance(tick)
        if condition.authority != "ours":
            self._watchdog.feed()  # nothing is to be flown
            if order.action == "land" and condition.authority == "starting":
                self._vehicle.land()
            self._vehicle.pass_tick(tick.tick)
            self._put_off()
            self._control = None
            return

        age_s = max(0.0, self._clock.now_s() - telemetry.stamp_s)
        began = time.perf_counter()
        decision = self._decide(telemetry, tick, mode, terms)
        solve_s = time.perf_counter() - began
        if self._homecoming.landing:
            self._vehicle.land()  # before the answer to this tick, on which a simulator in lockstep goes on
        sent = self._vehicle.send(tick.tick, decision.velocity)
        self._watchdog.feed()
        self._report(tick.tick, decision, sent, solve_s, age_s)

    def _step_blindly(self, telemetry: Telemetry | None, tick: Tick, order: Order) -> None:
        """Stop, and say where the vehicle was: the others must not take its silence for flight."""
        if not self._blind:
            self._news.tell("error", "vehicle", "no sound telemetry: braking")
            self._blind = True
        self._put_off()
        self._vehicle.stop()
        if order.action == "land":
            self._vehicle.land()
        if telemetry is not None and np.isfinite(telemetry.pose).all():
            blind_s = min(max(0.0, self._clock.now_s() - telemetry.stamp_s), HOLDS_AFTER_S)
            self.mode, self._control = "yielded", None
            self._publish(replace(telemetry, velocity=np.zeros(5)), tick.tick, self.mode, blind_s)

    def _give_orders(self, telemetry: Telemetry | None, condition: Condition) -> Order:
        silence = None if self._lockstep else (self._ground_heard_s, self._now_s())
        if condition.authority == "landed":
            self._reserve.land()
        elif condition.authority == "ours" and telemetry is not None and self._is_sound(telemetry, condition):
            self._reserve.look(telemetry)
        order = self._orders.give(
            telemetry,
            condition,
            silence,
            self._finished,
            self._operator.action,
            reserve=self._reserve.share,
            map_silent_s=self._watch.silence,
        )
        self._swap.note(order, stays=bool(self._finished) or self._operator.action in ("return", "land"))
        return order

    def _fly_again(self, telemetry: Telemetry, condition: Condition) -> Condition:
        """What the vehicle's condition is, now that it has another battery."""
        if not self._vehicle.make_ready():
            return condition
        self._swap.renew(telemetry.stamp_s)
        self._homecoming = Homecoming(self._mission, self._drone, self._planner, self._watch.obstacles)
        return self._vehicle.condition()

    def _stands(self, telemetry: Telemetry) -> Telemetry:
        """Of one that has landed; what a silent one said last may be from before it stood still."""
        if not self._is_fresh(telemetry):
            telemetry = replace(telemetry, velocity=np.zeros(5))
        return self._swap.as_it_stands(telemetry)

    def _way_up_is_free(self, telemetry: Telemetry | None, tick: int) -> bool:
        """At first all take off together, each at its place; later others may be about."""
        if self._swap.count == 0:
            return True
        return telemetry is not None and self._swap.may_climb(telemetry, self._neighbours(telemetry, tick))

    def _put_off(self) -> None:
        """Something else than the planner, or nobody here, flies now."""
        self._homecoming.put_off()
        self._watch.put_off()

    def _publish(self, telemetry: Telemetry, tick: int, mode: Mode, blind_s: float = 0.0) -> None:
        state = self._state_of(telemetry, tick, mode, blind_s)
        self._replication.hear_state(state)
        self._bus.put(topics.STATE, state, self._drone)
        self._metrics.hear(state)
        self._published = tick
        self._landed_told += mode == "landed"
        if not self._lockstep:  # where nothing is lost, nothing need be repeated
            self._earlier.append((tick, state.pose))

    async def _advance(self, tick: Tick) -> SamplingTerms:
        """Bring phi forward; the sampling terms at the own pose."""
        if self._lockstep:
            await self._bus.until(lambda: bool(self._finished) or self._is_ready(tick.tick), LOCKSTEP_PATIENCE_S)
        steps = self._replication.integrate(tick.tick, self._bus.gone, self._wait_ticks)
        for step in steps:
            self._planner.note_team(step.ids, step.poses)
        if steps and steps[-1].terms is not None:
            return steps[-1].terms
        return self._replication.terms()

    def _is_ready(self, tick: int) -> bool:
        gone = self._bus.gone
        mapped = self._watch.is_ready(tick) or "ground" in gone
        return mapped and self._replication.is_ready(tick, gone)

    def _decide(self, telemetry: Telemetry, tick: Tick, mode: Mode, terms: SamplingTerms) -> Decision:
        neighbours = self._neighbours(telemetry, tick.tick)
        self._planner.note_deviation(telemetry.position_sd_m)
        self._watch.advance(tick.tick, telemetry.position_sd_m)
        if mode in ("returning", "landing"):
            return self._homecoming.steer(
                telemetry.pose,
                telemetry.velocity,
                neighbours,
                home=mode == "returning",
                now_s=self._clock.now_s(),
                deviation_m=telemetry.position_sd_m,
            )
        if mode in ("joining", "holding"):
            self._put_off()
            return self._planner.steer(telemetry.pose, telemetry.velocity, neighbours)
        self._homecoming.put_off()
        wish = self._watch.wish(telemetry.pose[:3], tick.time_s)
        if wish is not None:
            return self._planner.steer(telemetry.pose, telemetry.velocity, neighbours, wish)
        if tick.time_s - self._cells_at >= SHARE_PERIOD_S:
            row, poses = self._replication.newest()
            self._cells = float(self._replication.replica.field.owned_cells(poses)[row])
            self._cells_at = tick.time_s
        decision = self._planner.decide(telemetry.pose, telemetry.velocity, neighbours, terms, self._cells)
        self._watch.look(telemetry.pose[:3], decision, tick.time_s)
        return decision

    def _neighbours(self, telemetry: Telemetry, tick: int) -> list[Neighbour]:
        height_m = float(predicted_pose(telemetry.pose, telemetry.velocity, self._mission.flight)[2])
        return self._team.neighbours(tick, telemetry.delay_s, telemetry.position_sd_m, height_m)

    def _mode(self, condition: Condition, order: Order) -> Mode:
        by_authority: dict[str, Mode] = {
            "ready": "starting",
            "starting": "starting",
            "yielded": "yielded",
            "landing": "landing",
            "landed": "starting" if self._swap.is_awaited else "landed",
            "lost": "yielded",
        }
        if condition.authority in by_authority:
            return by_authority[condition.authority]
        if self._homecoming.landing:
            return "landing"
        by_order: dict[str, Mode] = {"hold": "holding", "return": "returning", "land": "landing"}
        if order.action in by_order:
            return by_order[order.action]
        if not self._replication.known:
            return "joining"
        return "braking" if self._control is not None and self._control.outcome != "solved" else "flying"

    def _is_sound(self, telemetry: Telemetry, condition: Condition) -> bool:
        """Alive, fresh and valid, in simulation too. One that has landed stands where it was, though it be silent: its
        battery may be out."""
        valid = bool(np.isfinite(telemetry.pose).all() and np.isfinite(telemetry.velocity).all())
        return valid and (condition.authority == "landed" or self._is_fresh(telemetry))

    def _is_fresh(self, telemetry: Telemetry) -> bool:
        return self._clock.now_s() - telemetry.stamp_s <= self._mission.vehicles.telemetry_stale_s

    def _state_of(self, telemetry: Telemetry, tick: int, mode: Mode, blind_s: float) -> DroneState:
        return DroneState(
            drone=self._drone,
            tick=tick,
            pose=tuple(telemetry.pose.tolist()),
            velocity=tuple(telemetry.velocity.tolist()),
            battery=telemetry.battery,
            mode=mode,
            obeyed=self._operator.number,
            blind_s=blind_s,
            earlier=tuple(
                entry for entry in self._earlier if entry[0] > min(self._published, tick - 1 - EARLIER_STATES)
            ),
            importance=self._replication.importance,
            replica=self._replication.state(),
            control=self._control,
            position_sd_m=telemetry.position_sd_m,
            angle_sd_rad=telemetry.angle_sd_rad,
            climb_m=self._climb_m or None,
        )

    def _report(self, tick: int, decision: Decision, sent: Floats, solve_s: float, age_s: float) -> None:
        if decision.outcome != "solved":
            self._fallbacks += 1
            if self._control is None or self._control.outcome != decision.outcome:
                self._news.tell("warning", "solver", f"{decision.outcome}: braking until it finds a way")
        rows = decision.rows
        self._control = Control(
            tick=tick,
            outcome=decision.outcome,
            velocity=tuple(sent.tolist()),
            slack=decision.slack,
            sampling=decision.sampling,
            solve_s=solve_s,
            separation_margin_m2=rows.margin("separation", UNLIMITED),
            region_margin_m=min(rows.margin("region", UNLIMITED), rows.margin("zone", UNLIMITED)),
            pitch_margin_rad2=rows.margin("pitch", UNLIMITED),
            active=decision.active,
            fallbacks=self._fallbacks,
            refused=self._bus.statistics.unused + self._replication.refused,
            telemetry_age_s=age_s,
            obstacle_margin_m=rows.margin("obstacle", UNLIMITED),
        )


async def run_agent(mission: Mission, drone: int, link: Link, *, lockstep: bool) -> None:
    """Fly one drone of ``mission`` until it ends."""
    compile_kernels()
    planner = make_planner(mission, drone)
    if mission.flight.obstacles.enabled:
        obstacles = Obstacles(mission)
        planner.heed(obstacles)
        WayUp(obstacles).rehearse()
    planner.rehearse()
    with MetricsEndpoint(mission, "agent", drone) as served:
        metrics = AgentMetrics(served.registry)
        async with connect(link, mission.name, lossless=lockstep) as bus:
            await Agent(mission, drone, bus, lockstep=lockstep, metrics=metrics).fly()
