"""Drones without a ground station: they go on for as long as the mission allows, then hold or land, and resume."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np
import pytest

from agents.agent import Agent
from faults.schedule import schedule
from faults.team import Team, flying
from faults.virtual_loop import VirtualLoop, run
from protocol.mission import Drone, Mission, Replication
from sim_bridge.simulator import Simulator

PATIENCE_S = 4.0
DRONES = (5, 9)


def mission(ground_lost: str) -> Mission:
    """That of the random schedules, for two drones far enough apart to land side by side."""
    drones = tuple(Drone(id=drone, start=(3.0 * k - 1.5, 0.0, 2.0, 0.0, 1.3)) for k, drone in enumerate(DRONES))
    replication = Replication(ground_patience_s=PATIENCE_S, ground_lost=ground_lost)
    return schedule(0).mission.model_copy(update={"drones": drones, "replication": replication, "duration_s": 60.0})


def modes(team: Team) -> set[str]:
    return {_agent(team, drone).mode for drone in DRONES}


def _agent(team: Team, drone: int) -> Agent:
    shell = team.members[f"drone/{drone}"].shell
    assert isinstance(shell, Agent)
    return shell


def bodies(team: Team) -> np.ndarray:
    """Poses (drones, 5) and velocities (drones, 5) of the vehicles, side by side."""
    shell = team.members["sim"].shell
    assert isinstance(shell, Simulator)
    return np.array([[*body.pose, *body.velocity] for body in shell._bodies.values()])


async def fly_without_ground(team: Team) -> None:
    """Start all, take the ground station away, and wait until drones have had enough."""
    for role in team.roles:
        team.start(role)
    await asyncio.sleep(6.0)
    assert modes(team) <= {"flying", "braking"}
    team.kill("ground")
    await asyncio.sleep(PATIENCE_S - 1.0)
    assert modes(team) <= {"flying", "braking"}, "they go on covering"
    await asyncio.sleep(3.0)


def in_virtual_time(ground_lost: str, folder: Path, then: object) -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        async with flying(mission(ground_lost), folder, seed=1) as team:
            await fly_without_ground(team)
            await then(team)  # type: ignore[operator]
            assert team.min_separation_m >= team.mission.flight.separation_m
        assert not loop.failures

    run(main())


def test_drones_hold_their_places_until_the_ground_station_is_back(tmp_path: Path) -> None:
    async def then(team: Team) -> None:
        assert modes(team) == {"holding"}
        before = bodies(team)
        await asyncio.sleep(5.0)
        assert np.abs(bodies(team)[:, :5] - before[:, :5]).max() < 0.02
        assert np.abs(bodies(team)[:, 5:]).max() < 0.01
        team.start("ground")
        await asyncio.sleep(4.0)
        assert modes(team) <= {"flying", "braking"}
        assert np.abs(bodies(team)[:, :5] - before[:, :5]).max() > 0.05, "they fly on"

    in_virtual_time("hold", tmp_path, then)


def test_drones_land_and_stay_on_the_ground(tmp_path: Path) -> None:
    async def then(team: Team) -> None:
        assert modes(team) == {"landing"}
        await asyncio.sleep(15.0)
        assert bodies(team)[:, 2] == pytest.approx(0.0, abs=0.03)
        assert modes(team) == {"landed"}
        team.start("ground")
        await asyncio.sleep(4.0)
        assert modes(team) == {"landed"}
        assert bodies(team)[:, 2] == pytest.approx(0.0, abs=0.03)

    in_virtual_time("land", tmp_path, then)
