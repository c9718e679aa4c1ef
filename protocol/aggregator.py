"""Gathers the states of a large team, so that a drone hears one message a tick instead of one from every other.

It runs in the router's process (docs/adr/0012). Everybody else goes on hearing each drone by itself.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import AsyncIterator, Iterable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field

from protocol import topics
from protocol.bus import Bus
from protocol.messages import DroneState, TeamStates, Tick, Vector5
from protocol.mission import Mission
from protocol.team_states import TimedPose, pack

log = logging.getLogger(__name__)

REPEATED = 3
"""Messages in which a pose is told again after its first: with one message in ten lost, one state in ten thousand is.
So long, too, a drone that fell silent is told of."""
REMEMBERED = 2 * (REPEATED + 1)
"""Messages after which a pose that comes again, repeated by its drone, would be taken for a new one."""
POSES_MAX = 16
"""Of one drone that are remembered: who floods the router must not fill its memory, nor the others' links."""
TICK_MAX = 2**31 - 1
"""What travels as int32; at 20 Hz three years."""
PATIENCE_TICKS = 0.5
"""How long states of a tick are waited for after its beat: what comes later is told with the next."""
LATE_TICKS = 0.5
"""How late a beat may be before states are gathered without it."""
ABOVE_S = 0.25
"""How long a router below another waits for that one's gathered states: less than a drone does (`agents.hearing`)."""
LOOK_S = 0.005
"""How often it is looked whether all states are in."""


def is_gathered(mission: Mission, *, lockstep: bool) -> bool:
    """Whether this mission's router gathers states. Not in lockstep, where everybody waits for each state anyway."""
    return not lockstep and len(mission.drones) > mission.transport.aggregate_above


@dataclass(slots=True)
class _Spoken:
    """What one drone said lately."""

    state: DroneState | None = None
    """The newest of those that are told still."""
    heard: int = 0
    """Round in which it came."""
    poses: dict[int, tuple[int, Vector5]] = field(default_factory=dict)
    """By tick, in the order in which they came: round of the first time, and pose."""

    def hear(self, state: DroneState, now: int) -> None:
        """An older state never replaces a newer one while that is told; after, the clock that it was from is gone."""
        if self.state is None or state.tick >= self.state.tick or now - self.heard > REPEATED:
            self.state, self.heard = state, now
        for tick, pose in (*state.earlier, (state.tick, state.pose)):
            self.poses.setdefault(tick, (now, pose))
            if len(self.poses) > POSES_MAX:
                del self.poses[next(iter(self.poses))]

    def told(self, now: int) -> tuple[DroneState, list[TimedPose]] | None:
        """Its newest state, and the other poses that are to be told; None when it has been silent."""
        self.poses = {tick: timed for tick, timed in self.poses.items() if now - timed[0] < REMEMBERED}
        if self.state is None or now - self.heard > REPEATED:
            return None
        newest = self.state.tick
        return self.state, [
            (tick, pose) for tick, (heard, pose) in self.poses.items() if now - heard <= REPEATED and tick != newest
        ]


class Gatherer:
    """Takes states in any order; one round is one message. It judges nobody's clock: that is the hearer's."""

    def __init__(self, drones: Iterable[int]) -> None:
        """``drones``: ids of the mission's; others are not listened to."""
        self._spoken = {drone: _Spoken() for drone in sorted(drones)}
        self._round = 0
        self._live: tuple[int, ...] = ()
        self.tick = -1
        """Of the newest beat."""
        self.refused = 0
        """States of strangers, or of ticks that cannot be."""

    def hear_tick(self, tick: Tick) -> None:
        self.tick, self._live = tick.tick, tick.live

    def hear(self, state: DroneState) -> None:
        spoken = self._spoken.get(state.drone)
        ticks = (state.tick, *(tick for tick, _ in state.earlier))
        if spoken is None or max(ticks) > TICK_MAX:
            self.refused += 1
        else:
            spoken.hear(state, self._round)

    @property
    def is_complete(self) -> bool:
        """Whether all drones that are live at the newest beat have spoken since."""
        spoken = (self._spoken[drone].state for drone in self._live if drone in self._spoken)
        return all(state is not None and state.tick >= self.tick for state in spoken)

    def take(self) -> TeamStates | None:
        """What is to be told in this round; the next begins. None when all are silent."""
        told = [spoken.told(self._round) for spoken in self._spoken.values()]
        self._round += 1
        states = [state for state in told if state is not None]
        return pack(states) if states else None


@asynccontextmanager
async def gathering(bus: Bus, mission: Mission, *, lockstep: bool) -> AsyncIterator[None]:
    """Gather while the block runs, if the mission's router is to. Should that fail, the router goes on routing, and
    drones hear each other by themselves."""
    if not is_gathered(mission, lockstep=lockstep):
        yield
        return
    task = asyncio.create_task(gather(bus, mission))
    task.add_done_callback(_tell_of_failure)
    try:
        yield
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError, Exception):
            await task


def _tell_of_failure(task: asyncio.Task[None]) -> None:
    error = None if task.cancelled() else task.exception()
    if error is not None:
        log.error("states are no longer gathered", exc_info=error)


async def gather(bus: Bus, mission: Mission) -> None:
    """Tell the team's states once a tick, until cancelled: as soon as all are in, or half a tick after the beat.

    Without beats, which vehicles that fly by themselves can do without, its own clock goes on. Of routers that hear
    each other the one at the top of the tree tells; one below it is silent while it hears that one.
    """
    gatherer = Gatherer(drone.id for drone in mission.drones)
    bus.on(topics.TICK, gatherer.hear_tick)
    bus.on(topics.STATE, gatherer.hear, wakes=False)
    now_s = asyncio.get_running_loop().time
    served, beaten = -1, True
    above_s = -math.inf

    def hear_above(_message: TeamStates) -> None:
        nonlocal above_s
        above_s = now_s()

    if mission.transport.uplinks:
        bus.on(topics.TEAM, hear_above, wakes=False)

    def is_beaten() -> bool:
        return gatherer.tick != served

    while True:
        beaten = await bus.until(is_beaten, mission.tick_s * (1 + LATE_TICKS if beaten else 1))
        served = gatherer.tick
        deadline_s = now_s() + PATIENCE_TICKS * mission.tick_s
        bus.poll()
        while beaten and not gatherer.is_complete and now_s() < deadline_s:
            await asyncio.sleep(LOOK_S)
            bus.poll()
        message = gatherer.take()
        if message is not None and now_s() - above_s > ABOVE_S:
            bus.put(topics.TEAM, message)
