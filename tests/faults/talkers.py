"""Drones that only talk: on the bus each is an agent with a session of its own, but it integrates and solves nothing.

``python -m faults.talkers --mission FILE --endpoint E --drones 1 2 3 --report FILE`` flies simulated vehicles along
circles, so that a machine carries more drones than it could fly. When it is ended, the report says how old the others'
states were when an agent would have used them.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import signal
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any, cast

import numpy as np

from agents.hearing import Hearing
from agents.team import Team
from protocol import topics, traffic_samples
from protocol.bus import Bus, connect
from protocol.credentials import identity_of_drone
from protocol.errors import MessageError
from protocol.links import link_of
from protocol.messages import DroneState, PhiPage, Setpoint, Tick, Vector5
from protocol.mission import Mission
from protocol.mission_file import load_mission
from protocol.replication import Replication
from protocol.team_states import Sighting

SPEED_MPS, TURN_RADPS = 0.3, 0.8
"""Of the circles, whose radius is less than a quarter of the distance at which drones start from each other."""
SOLVE_S = 0.002
"""Between a state and its setpoint: an agent's work, without which both would travel in one packet."""
LOOK_TICKS = 10
"""How often it is noted how old the others' states are."""


class Deaf:
    """Stands in for a `Replication` that would integrate what it hears."""

    def hear_state(self, state: DroneState | Sighting) -> bool:
        return bool(state)


class Talker:
    def __init__(self, mission: Mission, drone: int, bus: Bus) -> None:
        self._mission, self._drone, self._bus = mission, drone, bus
        self._sample = traffic_samples.state(drone)
        self._earlier: list[tuple[int, Vector5]] = []
        self.ages_s: list[float] = []
        """Of the others' newest states, in ticks' time, when an agent would have used them."""
        self.events: list[str] = []
        starts = {other.id: other.start for other in mission.drones}
        self._team = Team(drone, starts, mission.flight, mission.tick_s)
        replication = cast("Replication", Deaf())
        self._hearing = Hearing(mission, drone, bus, replication, self._team, self._note, lockstep=False)
        bus.on(topics.TICK, self._hear_tick)
        for topic in (topics.JUMP, topics.HEAD, topics.DIGEST, topics.PHASE):
            bus.on(topic, lambda _message: None)
        bus.serve(topics.DRONE_BLOCKS, _know_nothing, drone)
        bus.watch_lives()
        bus.announce(f"drone/{drone}")

    def _note(self, level: str, kind: str, text: str) -> None:
        self.events.append(f"{level} {kind}: {text}")

    def _hear_tick(self, tick: Tick) -> None:
        """Once the burst of messages that it came with has been handled."""
        asyncio.get_running_loop().call_soon(self._step, tick)

    def _step(self, tick: Tick) -> None:
        own = next((sample for sample in tick.vehicles if sample.drone == self._drone), None)
        if own is None:
            return
        self._hearing.tick = tick.tick
        self._hearing.look()
        state = self._sample.model_copy(
            update={
                "tick": tick.tick,
                "pose": own.pose,
                "velocity": own.velocity,
                "earlier": tuple(self._earlier[-traffic_samples.EARLIER :]),
                "replica": self._sample.replica.model_copy(update={"tick": max(0, tick.tick - 1)}),
            }
        )
        self._bus.put(topics.STATE, state, self._drone)
        self._earlier = [*self._earlier[-traffic_samples.EARLIER :], (tick.tick, own.pose)]
        angle = TURN_RADPS * tick.time_s
        velocity = (SPEED_MPS * math.cos(angle), SPEED_MPS * math.sin(angle), 0.0, 0.1, 0.0)
        setpoint = Setpoint(drone=self._drone, tick=tick.tick, velocity=velocity)
        asyncio.get_running_loop().call_later(SOLVE_S, self._bus.put, topics.SETPOINT, setpoint, self._drone)
        if tick.tick % LOOK_TICKS == self._drone % LOOK_TICKS:
            self.ages_s += [neighbour.age_s for neighbour in self._team.neighbours(tick.tick)]


async def _know_nothing(_parameters: dict[str, str]) -> PhiPage:
    raise MessageError("only talks")


async def talk(mission: Mission, endpoint: str, drones: list[int]) -> dict[str, Any]:
    """Until SIGTERM; what is to be reported."""
    ended = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, ended.set)
    links = {drone: link_of(mission, identity_of_drone(drone), endpoint=endpoint) for drone in drones}
    async with AsyncExitStack() as stack:
        talkers = [
            Talker(mission, drone, await stack.enter_async_context(connect(link, mission.name)))
            for drone, link in links.items()
        ]
        await ended.wait()
    ages_s = np.concatenate([talker.ages_s[len(talker.ages_s) // 4 :] for talker in talkers])
    return {
        "used_age_s": {str(share): float(np.percentile(ages_s, share)) for share in (50, 99)},
        "events": [event for talker in talkers for event in talker.events],
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m faults.talkers", description=__doc__)
    parser.add_argument("--mission", type=Path, required=True)
    parser.add_argument("--endpoint", required=True)
    parser.add_argument("--drones", type=int, nargs="+", required=True)
    parser.add_argument("--report", type=Path, required=True)
    told = parser.parse_args()
    report: Path = told.report
    report.write_text(json.dumps(asyncio.run(talk(load_mission(told.mission), told.endpoint, told.drones))))
