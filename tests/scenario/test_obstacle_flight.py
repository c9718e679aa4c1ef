"""Whole flights in rooms that nobody knows before: nothing is touched, nobody is held for ever, all get home."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path
from typing import get_args
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from agents.agent import Agent
from agents.climbing import CLIMB_S
from agents.homing import Homecoming
from agents.obstacles import Obstacles
from faults.schedule import schedule
from faults.scripted_mapper import ScriptedMapper
from faults.seen_room import RoomFlight, boxes_of, not_free, room_mission
from faults.team import Team, flying
from faults.virtual_loop import VirtualLoop, run
from protocol.messages import FreeCells
from protocol.mission import Mission
from protocol.obstacle_grid import Cells, ObstacleGrid, kept_distance, period_ticks
from protocol.planner_settings import PlannerName

STALE_S = 2.0
POLL_S = 0.1


def fly(flight: RoomFlight, ticks: int) -> None:
    for _ in range(ticks):
        flight.step()


def test_two_drones_go_down_into_a_room_as_they_see_it_and_come_home() -> None:
    flight = RoomFlight(room_mission(), boxes=boxes_of(1))
    lowest = math.inf
    for _ in range(900):
        flight.step()
        lowest = min(lowest, *(body.pose[2] for body in flight.bodies))

    assert lowest < flight.obstacles[0].clear_m - 0.1, "they fly where they have seen, and not above it all alone"
    _bring_home(flight)

    assert flight.nearest_m >= flight.mission.flight.clearance_m
    assert flight.min_separation >= flight.mission.flight.separation_m
    assert flight.outcomes.count("solved") > 0.98 * len(flight.outcomes)


def _bring_home(flight: RoomFlight) -> None:
    """From below the height of things to above the starts, and down as far as is known to be free."""
    mission = flight.mission
    homecomings = [
        Homecoming(mission, drone.id, planner, obstacles)
        for drone, planner, obstacles in zip(mission.drones, flight.planners, flight.obstacles, strict=True)
    ]
    for _ in flight.bring_home(homecomings, 900):
        for body, obstacles in zip(flight.bodies, flight.obstacles, strict=True):
            assert not_free(flight.grid, obstacles.free, body.pose[:3]) >= mission.flight.clearance_m
    for body, drone in zip(flight.bodies, mission.drones, strict=True):
        assert math.dist(body.pose[:2], drone.start[:2]) < 0.3


@pytest.mark.parametrize("planner", get_args(PlannerName))
def test_no_planner_touches_what_it_has_not_seen(planner: PlannerName) -> None:
    flight = RoomFlight(room_mission(controller={"planner": planner}), boxes=boxes_of(2))
    fly(flight, 200)
    assert flight.nearest_m >= flight.mission.flight.clearance_m
    assert flight.path_m > 0.4


@st.composite
def rooms(draw: st.DrawFn) -> RoomFlight:
    """Random boxes, lags, speeds, clearances and sizes of cells."""
    response, speed = draw(st.sampled_from([0.0, 0.15, 0.25])), draw(st.sampled_from([0.3, 0.5, 0.8]))
    flight = room_mission().flight.model_dump() | {
        "response_time_s": response,
        "speed_max_mps": speed,
        "acceleration_max_mps2": max(4.0, speed / response if response else 4.0),
        "clearance_m": draw(st.sampled_from([0.15, 0.3])),
        "obstacles": {"enabled": True, "cell_m": draw(st.sampled_from([0.1, 0.15])), "stuck_s": 2.0},
    }
    return RoomFlight(room_mission(flight=flight), boxes=boxes_of(draw(st.integers(0, 10_000))))


@settings(max_examples=5, deadline=None, suppress_health_check=[HealthCheck.too_slow], derandomize=True)
@given(flight=rooms())
def test_drones_touch_nothing_whatever_the_room_is_like(flight: RoomFlight) -> None:
    fly(flight, 200)
    assert flight.nearest_m >= flight.mission.flight.clearance_m
    assert flight.min_separation >= flight.mission.flight.separation_m


def held(place: tuple[float, float, float], *, climbs: bool = True) -> tuple[RoomFlight, float]:
    """A drone that starts low, is pulled aside and sees nothing: all cells below and beside its start stay unknown. The
    flight, and how long it took until it was above all."""
    mission = room_mission([place])
    pull = np.array([0.4, 0.1, -0.1, 0.0, 0.0])
    flight = RoomFlight(mission, boxes=boxes_of(0)[-1:], climbs=climbs, pull=pull, sees=False)
    clear_m, dt = flight.obstacles[0].clear_m, mission.tick_s
    limit_s = 2 * (mission.flight.obstacles.stuck_s + CLIMB_S)
    while flight.bodies[0].pose[2] < clear_m and flight.tick * dt < limit_s:
        flight.step()
    return flight, flight.tick * dt


@pytest.mark.parametrize("place", [(0.3, -0.2, 1.0), (-1.2, 1.0, 0.8), (0.9, 0.9, 0.6)])
def test_a_drone_that_obstacles_hold_climbs_and_the_climb_ends(place: tuple[float, float, float]) -> None:
    flight, took_s = held(place)

    assert flight.climbing[0].count >= 1
    assert took_s < flight.mission.flight.obstacles.stuck_s + CLIMB_S
    free, kept = flight.obstacles[0].free, kept_distance(flight.mission.flight)
    assert not_free(flight.grid, free, flight.bodies[0].pose[:3]) >= kept - 0.05, "and no row was relaxed for it"


def test_without_the_rule_it_would_stay_where_it_is() -> None:
    flight, _ = held((0.3, -0.2, 1.0), climbs=False)
    assert flight.bodies[0].pose[2] < flight.obstacles[0].clear_m


def obstacles_of(mission: Mission) -> Mission:
    """The flight of the fault tests, with a map of free cells that sees nothing."""
    flight = mission.flight.model_dump() | {"obstacles": {"enabled": True, "stale_s": STALE_S, "clear_above_m": 0.7}}
    changed = Mission.model_validate(mission.model_dump() | {"flight": flight, "duration_s": 30.0})
    assert changed.flight.obstacles.enabled
    return changed


def test_drones_hold_while_no_map_of_free_cells_comes(tmp_path: Path) -> None:
    """ "obstacle map stale" stops all when the ground station is silent, and is over when it is heard again."""
    mission = obstacles_of(schedule(0).mission)
    told: list[tuple[float, str, str]] = []

    async def main() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        async with flying(mission, tmp_path, seed=1) as team:
            for role in team.roles:
                team.start(role)
            await _until(loop, 6.0, team, told)
            team.black_hole("ground", active=True)
            await _until(loop, 12.0, team, told)
            team.black_hole("ground", active=False)
            await _until(loop, 20.0, team, told)
            assert not team.failed()
        assert not loop.failures

    run(main())
    rows = [row for _, row, _ in told]
    assert rows == ["as planned", "obstacle map stale", "as planned"]
    assert 6.0 + STALE_S - 1.0 < told[1][0] < 6.0 + STALE_S + 1.5
    assert told[1][2] == "hold"


async def _until(loop: VirtualLoop, end_s: float, team: Team, told: list[tuple[float, str, str]]) -> None:
    """Note each new order of the first drone."""
    while loop.time() < end_s:
        await asyncio.sleep(0.1)
        shell = team.members[f"drone/{team.mission.drones[0].id}"].shell
        if not isinstance(shell, Agent) or team.tick < 5:
            continue
        order = shell._orders.newest
        if not told or told[-1][1] != order.policy:
            told.append((loop.time(), order.policy, order.action))


def test_in_lockstep_all_fly_by_the_same_map_at_the_same_tick(tmp_path: Path) -> None:
    mission = obstacles_of(schedule(0).mission).model_copy(update={"duration_s": 3.0})
    flown: dict[int, list[bytes]] = {}
    advance, dice = Obstacles.advance, np.random.default_rng(1)

    def note(self: Obstacles, tick: int, deviation_m: float = 0.0) -> None:
        advance(self, tick, deviation_m)
        flown.setdefault(tick, []).append(self.free.tobytes())

    def free_cells(_self: ScriptedMapper, grid: ObstacleGrid) -> Cells:
        return np.asarray(dice.random(grid.shape) < 0.5) | grid.vouched

    async def main() -> None:
        async with flying(mission, tmp_path, seed=1, lockstep=True) as team:
            for role in team.roles:
                team.start(role)
            while not team.members["ground"].task.done():  # noqa: ASYNC110  # a task of another process
                await asyncio.sleep(POLL_S)
            assert not team.failed()

    with patch.object(Obstacles, "advance", note), patch.object(ScriptedMapper, "free_cells", free_cells):
        run(main())
    period = period_ticks(mission)
    assert len(flown) > 4 * period
    for tick, maps in flown.items():
        assert len(maps) == len(mission.drones)
        assert len({*maps}) == 1, "the same for all"
        changed = tick > 0 and maps[0] != flown[tick - 1][0]
        assert changed == (tick % period == 0 and tick > 0), "and a new one when it is due"


def test_a_map_is_small_enough_for_a_slow_link() -> None:
    flight = RoomFlight(room_mission(), boxes=boxes_of(3))
    fly(flight, 100)
    message = FreeCells(tick=1, packed=flight.grid.pack(flight.seen))
    assert len(message.packed) < 2000
