"""Flights of drones that do not quite know where they are, in virtual time and lockstep."""

from __future__ import annotations

import asyncio
import hashlib
import itertools
import math
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from agents.agent import Agent
from agents.orders import Orders
from agents.policies import Order
from faults.located_team import LocatedTeam, located
from faults.schedule import schedule
from faults.team import Team, flying
from faults.virtual_loop import VirtualLoop, run
from protocol.geometry import Floats
from protocol.localization_settings import EstimateNoise, Localization
from protocol.messages import DroneState
from protocol.mission import Drone, Mission
from sim_bridge.believed import BelievedPoses
from sim_bridge.lidar import LidarSensor
from sim_bridge.scenes.scene import Scene
from sim_bridge.scenes.texture_set import TextureSet
from sim_bridge.simulator import Simulator

LOST_S = 2.0


def mission(localization: Localization, noise: EstimateNoise, drones: int, duration_s: float) -> Mission:
    base = schedule(0).mission
    team = tuple(Drone(id=k + 1, start=(2.0 * k - 1.0, 1.5 * k - 0.5, 2.0, 0.3, 1.3)) for k in range(drones))
    simulation = base.simulation.model_copy(update={"estimate": noise})
    return base.model_copy(
        update={"drones": team, "simulation": simulation, "localization": localization, "duration_s": duration_s}
    )


def agent(team: Team, drone: int) -> Agent:
    shell = team.members[f"drone/{drone}"].shell
    assert isinstance(shell, Agent)
    return shell


def test_drones_that_no_longer_know_where_they_are_hold_and_then_land(tmp_path: Path) -> None:
    """ "position unsure" stops both when their estimates have drifted too far, "position lost" brings them down."""
    noise = EstimateNoise(drift_m=0.3, drift_s=8.0)
    lost = mission(Localization(deviation_max_m=0.2, lost_s=LOST_S), noise, drones=2, duration_s=40.0)
    rows: list[str] = []
    given: list[tuple[Orders, Order]] = []
    give = Orders.give

    def note(self: Orders, *told: Any, **more: Any) -> Order:
        order = give(self, *told, **more)
        given.append((self, order))
        return order

    async def main() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        async with flying(lost, tmp_path, seed=1, lockstep=True) as team:
            for role in team.roles:
                team.start(role)
            with patch.object(Orders, "give", note):
                while not team.members["ground"].task.done():  # noqa: ASYNC110  # a task of another process
                    await asyncio.sleep(0.05)
                first = agent(team, 1)._orders
            rows.extend(order.policy for orders, order in given if orders is first)
            simulator = team.members["sim"].shell
            assert isinstance(simulator, Simulator)
            assert [body.is_down for body in simulator._bodies.values()] == [True, True]
            assert team.min_separation_m >= lost.flight.separation_m
            assert not team.failed()
        assert not loop.failures

    run(main())
    assert [row for row, _ in itertools.groupby(rows)][:3] == ["as planned", "position unsure", "position lost"]


def furnished() -> Scene:
    """A room of 9 x 9 x 6 m with a few boxes: triangles alone."""
    dice = np.random.default_rng(0)
    boxes = [(np.array([-4.5, -4.5, 0.0]), np.array([4.5, 4.5, 6.0]))]
    for _ in range(6):
        low = np.array([*dice.uniform(-4, 3, 2), 0.0])
        boxes.append((low, low + dice.uniform(0.4, 1.0, 3)))
    triangles = np.concatenate([_box(low, high) for low, high in boxes]).astype(np.float32)
    count = len(triangles)
    nothing = TextureSet(np.zeros((1, 4), np.uint8), np.zeros(1, np.int64), np.ones((1, 2), np.int32))
    return Scene(
        triangles, np.zeros((count, 3, 2), np.float32), np.ones((count, 3, 3), np.float32), np.zeros(count, np.int32),
        np.ones(count, np.bool_), nothing, "",
    )  # fmt: skip


def _box(low: Floats, high: Floats) -> Floats:
    corners = np.array([[(low, high)[k >> axis & 1][axis] for axis in range(3)] for k in range(8)])
    faces = [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)]
    return np.array(
        [[corners[a], corners[b], corners[c]] for p, q, r, s in faces for a, b, c in ((p, q, r), (p, r, s))]
    )


def fly_by_lidar(folder: Path) -> tuple[str, list[float], list[float]]:
    """Digest of all that was believed, the errors of each tick, and the deviations that were told; of one drone whose
    vehicle knows little of its place."""
    noise = EstimateNoise(drift_m=1.0, drift_s=5.0, velocity_mps=0.05, white_m=0.02)
    flown = mission(Localization(source="lidar"), noise, drones=1, duration_s=6.0)
    digest, errors, told = hashlib.sha256(), [], []

    def compare(team: LocatedTeam, state: DroneState) -> None:
        digest.update(np.array(state.pose).tobytes())
        errors.append(math.dist(team.truth(state)[:3], state.pose[:3]))
        told.append(state.position_sd_m)

    async def main() -> None:
        async with located(flown, folder, seed=1) as team:
            team.sensor = sensor
            hear = BelievedPoses.hear

            def hear_and_compare(self: BelievedPoses, state: DroneState) -> None:
                hear(self, state)
                compare(team, state)

            with patch.object(BelievedPoses, "hear", hear_and_compare):
                await team.until_over()
            assert not team.failed()

    sensor = LidarSensor(furnished(), flown.lidar, flown.seed)
    run(main())
    return digest.hexdigest(), errors, told


@pytest.mark.timeout(240)
def test_a_lidar_keeps_a_drone_located_whose_vehicle_is_lost_and_the_same_seed_is_the_same_flight(
    tmp_path: Path,
) -> None:
    first, errors, told = fly_by_lidar(tmp_path / "first")
    second, _, _ = fly_by_lidar(tmp_path / "second")
    assert first == second
    assert len(errors) > 100
    assert max(errors) < 0.05
    assert np.mean(np.array(errors) > 3 * np.array(told)) < 0.01
