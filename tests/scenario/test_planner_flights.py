"""Every planner flies the paper's field, alone and in a team of four: judged by one importance, kept apart alike."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from agents.agent import Agent
from agents.planners.choice import make_planner
from agents.planners.lawnmower import Lawnmower
from agents.planners.persistent import PersistentCoverage
from faults.schedule import schedule
from faults.team import flying
from faults.team_flight import TeamFlight
from faults.virtual_loop import run
from protocol.mission import Controller, Drone, Mission
from protocol.planner_settings import DOWNWARD, PlannerName

SEEN_S: dict[PlannerName, tuple[float, float]] = {
    "coverage": (71.0, 33.0),
    "lawnmower": (110.0, 28.0),
    "persistent": (90.0, 25.0),
    "angle_aware_down": (101.0, 36.0),
    "angle_aware": (101.0, 36.0),
}
"""Measured times to J = 0.6 of one drone and of four, from these starts; flights are chaotic."""


@pytest.mark.parametrize("drones", [1, 4])
@pytest.mark.parametrize("planner", get_args(PlannerName))
def test_importance_falls_in_the_planner_s_own_time_and_nobody_comes_too_near(
    planner: PlannerName, drones: int
) -> None:
    row = tuple(Drone(id=k + 1, start=(1.1 * k, 1.0, 2.0, 0.0, 1.3)) for k in range(drones))
    flight = TeamFlight(Mission(controller=Controller(planner=planner), drones=row))
    seen_s = SEEN_S[planner][drones > 1]

    assert flight.time_to(0.6, limit_s=1.3 * seen_s) == pytest.approx(seen_s, rel=0.3)

    assert drones == 1 or flight.min_separation >= flight.mission.flight.separation_m
    assert flight.outcomes.count("solved") > 0.99 * len(flight.outcomes)
    for body in flight.bodies:
        assert planner == "coverage" or body.pose[2] == pytest.approx(2.0, abs=0.02)
        assert planner not in DOWNWARD or body.pose[4] == pytest.approx(math.pi / 2, abs=0.01)


@pytest.mark.parametrize("drones", [1, 4, 7])
def test_a_team_of_lawnmowers_sweeps_its_parts_without_waiting_for_one_another_for_ever(drones: int) -> None:
    row = tuple(Drone(id=k + 1, start=(1.1 * k - 3.3, 1.0, 2.0, 0.0, 1.3)) for k in range(drones))
    flight = TeamFlight(Mission(controller=Controller(planner="lawnmower"), drones=row))
    planners = [planner for planner in flight.planners if isinstance(planner, Lawnmower)]
    for _ in range(round(320 / drones / flight.mission.tick_s) + 600):
        flight.step()

    assert min(planner.passes for planner in planners) >= 2
    assert sum(planner.left_out for planner in planners) <= drones
    assert drones == 1 or flight.min_separation >= 1.0


@pytest.mark.parametrize("planner", get_args(PlannerName))
def test_the_agents_fly_the_planner_that_the_mission_asks_for(planner: PlannerName, tmp_path: Path) -> None:
    """The whole Agent, in virtual time on a network without faults: what it decides, and what it tells its planner."""
    row = tuple(Drone(id=drone, start=(3.0 * k - 1.5, 0.0, 2.0, 0.0, 1.3)) for k, drone in enumerate((5, 9)))
    mission = schedule(0).mission.model_copy(
        update={"drones": row, "controller": Controller(planner=planner), "duration_s": 60.0}
    )

    async def main() -> None:
        async with flying(mission, tmp_path, seed=1) as team:
            for role in team.roles:
                team.start(role)
            await asyncio.sleep(15.0)
            flown = [team.members[f"drone/{drone.id}"].shell for drone in row]
            for agent in flown:
                assert isinstance(agent, Agent)
                assert type(agent._planner) is type(make_planner(mission, row[0].id))
                assert agent.mode == "flying"
            fields = [agent._planner.importance for agent in flown if isinstance(agent._planner, PersistentCoverage)]
            if fields:
                assert 0.3 < fields[0].mean() < 0.95, "it is told what the team sees"
                tick = mission.sensing.decay_per_s * mission.tick_s  # one may be ahead by it
                np.testing.assert_allclose(fields[0], fields[1], atol=tick)

    run(main())
