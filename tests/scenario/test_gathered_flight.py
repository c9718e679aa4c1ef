"""A large team on bad links flies by gathered states: nobody comes near another, and phi ends up the same."""

from __future__ import annotations

import asyncio
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

from agents.agent import Agent
from faults.link import Faults
from faults.team import Member, Team, flying
from faults.virtual_loop import run
from ground_station.ground_station import GroundStation
from protocol import topics
from protocol.map_settings import Feedback, Reconstruction
from protocol.messages import DroneState, Event
from protocol.mission import Drone, Flight, Mission, Simulation, Target
from protocol.wire import decode

SIDE = 3
MISSION = Mission(
    name="gathered",
    duration_s=60.0,
    target=Target(lower_m=(-2.0, -2.0, 0.0), upper_m=(2.0, 2.0, 2.0), cell_m=0.5, cell_rad=0.6),
    flight=Flight(
        lower_m=(-2.5, -2.5, 0.5),
        upper_m=(2.5, 2.5, 2.5),
        speed_max_mps=1.0,
        turn_rate_max_radps=1.0,
        acceleration_max_mps2=8.0,
    ),
    feedback=Feedback(method="none"),
    reconstruction=Reconstruction(backend="none"),
    simulation=Simulation(scene="", start_patience_s=2.0),
    drones=tuple(
        Drone(id=1 + SIDE * row + column, start=(1.4 * column - 1.4, 1.4 * row - 1.4, 1.5, 0.7 * row, 1.3))
        for row in range(SIDE)
        for column in range(SIDE)
    ),
)
"""Nine drones: one more than hear each other directly."""
BAD = Faults(loss=0.1, jitter_s=0.06)
"""Of every link, both ways; messages overtake each other by more than a tick."""
BAD_S, HEALED_S = 20.0, 26.0
PHI_TOLERANCE = 1e-5


class Overheard:
    def __init__(self, team: Team) -> None:
        self.events: list[Event] = []
        self.states: dict[int, DroneState] = {}
        self.said: set[tuple[int, int]] = set()
        """Drone and tick of each state that was said at all: a drone that misses a beat says nothing of it."""
        self.keys: set[str] = set()
        team.network.taps.append(lambda _, key, payload: self._hear(key, payload))

    def _hear(self, key: str, payload: bytes) -> None:
        self.keys.add(key)
        if key.startswith("drone/") and key.endswith("/event"):
            self.events.append(decode(Event, payload))
        elif key.endswith("/state"):
            state = decode(DroneState, payload)
            self.states[state.drone] = state
            self.said |= {(state.drone, tick) for tick in (state.tick, *(tick for tick, _ in state.earlier))}


def subscriptions(member: Member) -> set[str]:
    return {key for key, _ in member.session.subscribers}


async def fly(team: Team, bad: Faults) -> None:
    for role in team.roles:
        team.start(role)
        if role != "sim":
            team.spoil(role, bad)
    await asyncio.sleep(BAD_S)
    for role in team.roles:
        team.spoil(role, Faults())
    await asyncio.sleep(HEALED_S - BAD_S)


def phis(team: Team) -> list[np.ndarray]:
    """Of all replicas that are as far as the most are."""
    replicas = [
        member.shell._replication.replica
        for member in team.members.values()
        if isinstance(member.shell, Agent | GroundStation)
    ]
    ticks = [replica.tick for replica in replicas]
    common = max(set(ticks), key=ticks.count)
    return [replica.field.phi.copy() for replica in replicas if replica.tick == common]


def test_nine_drones_keep_apart_and_end_with_the_same_phi_though_a_tenth_of_all_is_lost(tmp_path: Path) -> None:
    async def main() -> None:
        async with flying(MISSION, tmp_path, seed=3) as team:
            overheard = Overheard(team)
            await fly(team, BAD)
            drones = [member for role, member in team.members.items() if role.startswith("drone/")]
            assert all(topics.TEAM.key in subscriptions(member) for member in drones)
            assert not any(topics.STATE.of("*") in subscriptions(member) for member in drones)
            assert not [event for event in overheard.events if event.kind == "link"]

            assert not team.failed()
            assert team.tick * MISSION.tick_s > HEALED_S - 1.0
            assert team.min_separation_m >= MISSION.flight.separation_m
            states = overheard.states
            assert len(states) == len(MISSION.drones)
            assert all(state.importance < 0.75 for state in states.values())
            for state in states.values():
                unsaid = len(states) * state.replica.tick - sum(tick < state.replica.tick for _, tick in overheard.said)
                assert state.replica.lost - unsaid <= 0.001 * len(overheard.said), "each comes in four messages"
            equal = phis(team)
            assert len(equal) >= len(MISSION.drones) // 2
            assert max(float(np.sqrt(np.mean((phi - equal[0]) ** 2))) for phi in equal) < PHI_TOLERANCE

    run(main())


@pytest.mark.parametrize("bad", [Faults(), BAD], ids=["sound", "bad"])
def test_a_router_that_does_not_gather_costs_no_separation(bad: Faults, tmp_path: Path) -> None:
    """An external one, or an older: all hear each other directly from half a second on, and say so once."""

    async def main() -> None:
        with patch("faults.team.is_gathered", lambda _mission, *, lockstep: lockstep):
            async with flying(MISSION, tmp_path, seed=4) as team:
                overheard = Overheard(team)
                await fly(team, bad)
                assert topics.TEAM.key not in overheard.keys
                drones = [member for role, member in team.members.items() if role.startswith("drone/")]
                assert all(topics.STATE.of("*") in subscriptions(member) for member in drones)
                told = [event for event in overheard.events if event.kind == "link"]
                assert sorted(event.source for event in told) == sorted(f"drone/{d.id}" for d in MISSION.drones)
                assert not team.failed()
                assert team.min_separation_m >= MISSION.flight.separation_m
                assert all(state.importance < 0.75 for state in overheard.states.values())

    run(main())
