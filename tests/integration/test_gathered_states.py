"""The router's process gathers the states of a large team, and drones hear each other through it, or without it."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from agents.hearing import Hearing
from agents.team import Team
from deploy.local import environment
from faults.buses import PATIENCE_S
from protocol import topics
from protocol.aggregator import REPEATED
from protocol.bus import Bus, connect
from protocol.messages import DroneState, ReplicaState, Tick, Vector5
from protocol.mission import Drone, Mission, Target
from protocol.mission_file import mission_to_toml
from protocol.replication import Replication
from protocol.team_states import Sighting, unpack
from protocol.transport_settings import Transport

pytestmark = pytest.mark.light

NO_REPLICA = ReplicaState(tick=0, epoch=0, next_jump=0, missing=0, repaired=0, lost=0)
DRONES = (1, 2, 3)
LARGE = Mission(
    name="gathered",
    target=Target(cell_m=1.0, cell_rad=1.0),
    drones=tuple(Drone(id=drone, start=(1.5 * drone - 3, 0.0, 2.0, 0.0, 1.3)) for drone in DRONES),
    transport=Transport(aggregate_above=2),
)
SMALL = LARGE.model_copy(update={"transport": Transport(aggregate_above=3)})
Start = Callable[..., "subprocess.Popen[bytes]"]


@pytest.fixture
def start(tmp_path: Path, endpoint: str) -> Iterator[Start]:
    started: list[subprocess.Popen[bytes]] = []

    def start(mission: Mission, speed: str = "1", at: str = endpoint) -> subprocess.Popen[bytes]:
        path = tmp_path / f"mission-{len(started)}.toml"
        path.write_text(mission_to_toml(mission))
        command = [sys.executable, "-P", "-m", "protocol.router", "--mission", str(path), "--run", str(tmp_path)]
        router = subprocess.Popen([*command, "--endpoint", at, "--speed", speed], env=environment(os.environ))
        started.append(router)
        return router

    yield start
    for router in started:
        router.kill()
        router.wait()


def pose(drone: int, tick: int) -> Vector5:
    return (drone + 0.1 * tick, 1 / 3, 2.0, 0.01 * tick, 1.3)


def beat(tick: int) -> Tick:
    return Tick(
        tick=tick, time_s=tick * 0.05, lockstep=False, live=DRONES, vehicles=(), jump_epoch=0, next_jump=0, keyframes=0
    )


def state(drone: int, tick: int) -> DroneState:
    return DroneState(
        drone=drone,
        tick=tick,
        pose=pose(drone, tick),
        velocity=(0.1, 0.0, 0.0, 0.01, 0.0),
        battery=1.0,
        mode="flying",
        importance=1.0,
        replica=NO_REPLICA,
        control=None,
    )


@dataclass
class Pair:
    """Who speaks for the simulator and all drones, and who listens."""

    speaker: Bus
    listener: Bus
    gathered: list[list[Sighting]] = field(default_factory=list)
    direct: list[DroneState] = field(default_factory=list)

    @property
    def newest(self) -> list[Sighting]:
        return self.gathered[-1] if self.gathered else []

    def say(self, tick: int, drones: tuple[int, ...] = DRONES) -> None:
        self.speaker.put(topics.TICK, beat(tick))
        for drone in drones:
            self.speaker.put(topics.STATE, state(drone, tick), drone)

    async def say_until(self, condition: Callable[[], bool], first: int) -> int:
        """A tick after the other until it holds; the last."""
        for tick in range(first, first + round(PATIENCE_S / LARGE.tick_s)):
            self.say(tick)
            if await self.listener.until(condition, LARGE.tick_s):
                return tick
        raise AssertionError("it never came")


@asynccontextmanager
async def pair(endpoint: str) -> AsyncIterator[Pair]:
    async with connect(endpoint, LARGE.name) as speaker, connect(endpoint, LARGE.name) as listener:
        made = Pair(speaker, listener)
        listener.on(topics.TEAM, lambda message: made.gathered.append(unpack(message)))
        listener.on(topics.STATE, made.direct.append)
        yield made


async def test_a_tick_of_a_large_team_comes_as_one_message_with_all_that_was_said(endpoint: str, start: Start) -> None:
    start(LARGE)
    async with pair(endpoint) as both:
        first = 1 + await both.say_until(lambda: bool(both.gathered), 0)
        for tick in range(first, first + 20):
            before = len(both.gathered)
            both.say(tick)
            assert await both.listener.until(
                lambda tick=tick: [seen.tick for seen in both.newest] == [tick] * len(DRONES), PATIENCE_S
            )
            assert len(both.gathered) - before <= 2, "states that came too late for one come with the next"
        newest = both.gathered[-1]

    assert [(seen.drone, seen.pose) for seen in newest] == [(drone, pose(drone, tick)) for drone in DRONES]
    for seen in newest:
        assert sorted(seen.earlier) == [(before, pose(seen.drone, before)) for before in range(tick - REPEATED, tick)]


async def test_one_that_fell_silent_is_soon_told_of_no_more(endpoint: str, start: Start) -> None:
    start(LARGE)
    async with pair(endpoint) as both:
        last = await both.say_until(lambda: bool(both.gathered) and len(both.gathered[-1]) == len(DRONES), 0)
        for tick in range(last + 1, last + 40):
            both.say(tick, drones=(1, 3))
            if await both.listener.until(lambda: [seen.drone for seen in both.newest] == [1, 3], LARGE.tick_s):
                break
        told = [seen.tick for message in both.gathered for seen in message if seen.drone == 2]

    assert [seen.drone for seen in both.newest] == [1, 3]
    assert max(told) <= last
    assert told.count(max(told)) <= REPEATED + 1


@pytest.mark.parametrize(("mission", "speed"), [(SMALL, "1"), (LARGE, "max")], ids=["small", "lockstep"])
async def test_small_teams_and_lockstep_are_not_gathered(
    endpoint: str, start: Start, mission: Mission, speed: str
) -> None:
    start(mission, speed)
    async with pair(endpoint) as both:
        last = await both.say_until(lambda: len(both.direct) >= len(DRONES), 0)
        for tick in range(last + 1, last + 10):
            both.say(tick)
            assert not await both.listener.until(lambda: bool(both.gathered), LARGE.tick_s)


async def test_of_two_routers_the_one_at_the_top_gathers_and_the_other_when_it_is_cut_off(
    endpoint: str, start: Start
) -> None:
    top = f"unixsock-stream/{endpoint.partition('/')[2]}.top"
    site = LARGE.model_copy(update={"transport": Transport(aggregate_above=2, uplinks=(top,))})
    router = start(LARGE, at=top)
    async with connect(top, LARGE.name) as above:
        start(site)
        async with pair(endpoint) as both:
            heard: list[int] = []
            above.on(topics.TEAM, lambda message: heard.append(int(message.ticks.max())))
            last = await both.say_until(lambda: len(heard) > 5, 0)
            both.gathered.clear()
            for tick in range(last + 1, last + 20):
                both.say(tick)
                assert await both.listener.until(
                    lambda tick=tick: any(seen.tick == tick for seen in both.newest), PATIENCE_S
                )
            assert len(both.gathered) <= 20, "each tick is told once"
            router.kill()
            router.wait()
            both.gathered.clear()
            await both.say_until(lambda: len(both.gathered) > 5, tick + 1)


async def test_a_drone_hears_its_team_through_the_router_and_without_it(endpoint: str, start: Start) -> None:
    """The router ends; an older one that does not gather takes its place, and is replaced in turn."""
    told: list[str] = []
    router = start(LARGE)
    async with connect(endpoint, LARGE.name) as speaker, connect(endpoint, LARGE.name) as own:
        team = Team(1, {drone.id: drone.start for drone in LARGE.drones}, LARGE.flight, LARGE.tick_s)
        hearing = Hearing(
            LARGE, 1, own, Replication(LARGE, 1), team, lambda _, __, text: told.append(text), lockstep=False
        )
        own.watch_lives()
        speaker.announce("sim")
        tick = 0

        async def fly(condition: Callable[[], bool]) -> None:
            nonlocal tick
            both = Pair(speaker, own)
            for _ in range(round(PATIENCE_S / LARGE.tick_s)):
                tick += 1
                both.say(tick)
                await asyncio.sleep(LARGE.tick_s)
                hearing.tick = tick
                hearing.look()
                if condition():
                    return
            raise AssertionError(f"{told}, {team.neighbours(tick)}")

        def hears_all() -> bool:
            return all(neighbour.age_s <= LARGE.tick_s for neighbour in team.neighbours(tick))

        await fly(hears_all)
        assert not told
        router.kill()
        router.wait()
        assert await own.until(lambda: not own.alive, PATIENCE_S)
        older = start(SMALL)
        await fly(lambda: len(told) == 1)
        await fly(hears_all)
        older.kill()
        older.wait()
        assert await own.until(lambda: not own.alive, PATIENCE_S)
        start(LARGE)
        await fly(lambda: len(told) == 2)
        await fly(hears_all)

    assert told == [
        "the router gathers no states: hearing every drone by itself",
        "the router gathers states again",
    ]
