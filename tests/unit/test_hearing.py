"""A drone is never deaf because its router does not gather, and does not hear everything twice because it does."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Awaitable, Callable
from unittest.mock import patch

import zenoh

from agents.hearing import MISSED_S, STEADY_S, Hearing
from agents.team import Team
from faults.garbage import Rubbish
from faults.network import Network
from faults.session import Ring
from faults.virtual_loop import Process, run
from protocol import topics
from protocol.bus import Bus
from protocol.messages import DroneState, EventLevel, ReplicaState, TeamStates
from protocol.mission import Drone, Mission, Target
from protocol.replication import Replication
from protocol.team_states import pack
from protocol.transport_settings import Transport

MISSION = Mission(
    target=Target(cell_m=1.0, cell_rad=1.0),
    drones=tuple(Drone(id=drone, start=(1.5 * drone - 4, 0.0, 2.0, 0.0, 1.3)) for drone in (1, 2, 3)),
    transport=Transport(aggregate_above=2),
)
NO_REPLICA = ReplicaState(tick=0, epoch=0, next_jump=0, missing=0, repaired=0, lost=0)


def state(drone: int, tick: int) -> DroneState:
    return DroneState(
        drone=drone,
        tick=tick,
        pose=(0.0, float(tick), 2.0, 0.0, 1.3),
        velocity=(0.0,) * 5,
        battery=1.0,
        mode="flying",
        importance=1.0,
        replica=NO_REPLICA,
        control=None,
    )


class Listener:
    """Drone 1's hearing, and somebody who speaks for the router and drones 2 and 3."""

    def __init__(self, network: Network, mission: Mission, *, lockstep: bool = False) -> None:
        self._speaker = Process("speaker")
        self._said: Bus = self._speaker.call(lambda: Bus(network.session(self._speaker), lossless=False))  # type: ignore[arg-type]
        process = Process("drone/1")
        self.session = network.session(process)
        self.bus: Bus = process.call(lambda: Bus(self.session, lossless=False))  # type: ignore[arg-type]
        process.call(self.bus.watch_lives)
        process.call(self.bus.announce, "drone/1")
        self.team = Team(1, {drone.id: drone.start for drone in mission.drones}, mission.flight, mission.tick_s)
        self.told: list[tuple[EventLevel, str]] = []
        self.hearing: Hearing = process.call(
            lambda: Hearing(
                mission,
                1,
                self.bus,
                Replication(mission, 1),
                self.team,
                lambda level, kind, text: self.told.append((level, f"{kind}: {text}")),
                lockstep=lockstep,
            )
        )
        self._process = process
        self.tick = 0

    @property
    def keys(self) -> list[str]:
        return [key for key, _ in self.session.subscribers]

    async def pass_s(self, seconds: float, *, gathered: bool = False, direct: bool = True) -> None:
        """Ticks in which the other drones are heard in the one way or the other, or not."""
        for _ in range(round(seconds / MISSION.tick_s)):
            self.tick += 1
            states = [state(drone, self.tick) for drone in (1, 2, 3)]
            if gathered:
                self._speaker.call(self._said.put, topics.TEAM, pack((one, ()) for one in states))
            for one in states if direct else ():
                self._speaker.call(self._said.put, topics.STATE, one, one.drone)
            await asyncio.sleep(MISSION.tick_s)
            self.hearing.tick = self.tick
            self._process.call(self.hearing.look)

    def put(self, message: TeamStates) -> None:
        self._speaker.call(self._said.put, topics.TEAM, message)

    @property
    def ages_s(self) -> list[float]:
        return [neighbour.age_s for neighbour in self.team.neighbours(self.tick)]


def trial(body: Callable[[Network], Awaitable[None]]) -> None:
    async def main() -> None:
        dice = random.Random(1)
        await body(Network(dice, Rubbish(dice)))

    with patch.object(zenoh.handlers, "RingChannel", Ring):
        run(main())


def test_a_small_team_and_lockstep_hear_each_drone_by_itself() -> None:
    async def body(network: Network) -> None:
        small = MISSION.model_copy(update={"transport": Transport()})
        for listener in (Listener(network, small), Listener(network, MISSION, lockstep=True)):
            assert listener.keys == ["drone/*/state"]

    trial(body)


def test_a_large_team_is_heard_from_the_router_alone() -> None:
    async def body(network: Network) -> None:
        listener = Listener(network, MISSION)
        assert listener.keys == ["team/states"]
        await listener.pass_s(5.0, gathered=True)
        assert listener.ages_s == [0.0, 0.0], "its own state is none of its neighbours"
        assert listener.keys == ["team/states"]
        assert not listener.told

    trial(body)


def test_without_gathered_states_the_others_are_heard_directly_and_it_is_said_once() -> None:
    async def body(network: Network) -> None:
        listener = Listener(network, MISSION)
        await listener.pass_s(MISSED_S)
        assert listener.keys == ["team/states"]
        assert listener.ages_s == [MISSED_S] * 2, "silence grows meanwhile"
        await listener.pass_s(5.0)
        assert listener.keys == ["team/states", "drone/*/state"]
        assert listener.ages_s == [0.0, 0.0]
        assert listener.told == [("warning", "link: the router gathers no states: hearing every drone by itself")]

    trial(body)


def test_once_the_router_gathers_steadily_the_others_are_no_more_heard_directly() -> None:
    async def body(network: Network) -> None:
        listener = Listener(network, MISSION)
        await listener.pass_s(2.0)
        await listener.pass_s(STEADY_S / 2, gathered=True)
        await listener.pass_s(MISSED_S + MISSION.tick_s)
        await listener.pass_s(STEADY_S / 2, gathered=True)
        assert "drone/*/state" in listener.keys, "it came and went"
        await listener.pass_s(STEADY_S, gathered=True)
        assert listener.keys == ["team/states"]
        await listener.pass_s(1.0, gathered=True, direct=False)
        assert listener.ages_s == [0.0, 0.0]
        assert [level for level, _ in listener.told] == ["warning", "info"]
        await listener.pass_s(2.0)
        assert listener.keys == ["team/states", "drone/*/state"], "and it may stop again"

    trial(body)


def test_while_the_router_is_away_nobody_asks_for_more() -> None:
    async def body(network: Network) -> None:
        listener = Listener(network, MISSION)
        await listener.pass_s(1.0, gathered=True)
        network.black_hole(listener.session, active=True)
        await asyncio.sleep(3.0)  # longer than the lease
        await listener.pass_s(3.0)
        assert listener.keys == ["team/states"]
        network.black_hole(listener.session, active=False)
        await listener.pass_s(2.0, gathered=True)
        assert listener.ages_s == [0.0, 0.0]
        assert not listener.told

    trial(body)


def test_gathered_states_that_do_not_fit_are_counted_and_are_not_heard() -> None:
    async def body(network: Network) -> None:
        listener = Listener(network, MISSION)
        sound = pack([(state(2, 1), ())])
        await listener.pass_s(0.1)
        listener.put(sound.model_copy(update={"poses": sound.poses[:, :3]}))
        await listener.pass_s(2.0, direct=False)
        assert listener.bus.statistics.refused["team/states"] == 1
        assert not listener.bus.statistics.failed
        assert listener.told, "and the router counts as one that does not gather"

    trial(body)
