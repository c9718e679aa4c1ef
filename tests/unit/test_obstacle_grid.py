"""The lattice of free cells: what the mission vouches for, how it travels, and settings that make no sense."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pydantic import ValidationError

from faults.seen_room import room_mission, rough_map
from protocol.errors import MessageError
from protocol.messages import FreeCells
from protocol.mission import Mission
from protocol.obstacle_grid import ObstacleGrid, kept_distance


def test_cells_lie_on_the_target_box_and_cover_where_drones_fly() -> None:
    mission = room_mission()
    grid = ObstacleGrid.of(mission)
    steps = (np.array(mission.target.lower_m) - grid.origin) / grid.cell_m
    end = grid.origin + grid.cell_m * np.array(grid.shape)

    assert np.abs(steps - steps.round()).max() < 1e-9
    assert (grid.origin[:2] <= mission.flight.lower_m[:2]).all()
    assert grid.origin[2] <= mission.flight.lower_m[2] - kept_distance(mission.flight)
    assert (end[:2] >= mission.flight.upper_m[:2]).all()
    assert end[2] == pytest.approx(mission.target.upper_m[2]), "above it the crew vouches"


def test_a_start_is_vouched_for_and_the_way_up_from_it() -> None:
    mission = room_mission([(-1.0, 0.0, 0.9), (1.0, 0.0, 2.0)])
    grid, kept = ObstacleGrid.of(mission), kept_distance(mission.flight)
    centres = grid.origin + grid.cell_m * (np.argwhere(~grid.vouched) + 0.5)

    for height in (0.9, 1.1, 1.6):
        nearest = np.linalg.norm(centres - np.array([-1.0, 0.0, height]), axis=1).min()
        assert nearest > kept + math.sqrt(0.75) * grid.cell_m, "so that the cell's cube is farther than that as well"
    assert not grid.vouched[:, :, :2].any(), "not below: what it starts above may be a table"


def test_a_vehicle_that_took_off_from_the_ground_may_land_there() -> None:
    mission = room_mission([(-1.0, 0.0, 2.0)], vehicles={"kind": "px4"})
    grid = ObstacleGrid.of(mission)
    x, y = np.floor((np.array([-1.0, 0.0]) - grid.origin[:2]) / grid.cell_m).astype(int)
    assert grid.vouched[x, y].all()


@pytest.mark.parametrize("seed", range(5))
def test_cells_arrive_as_they_were_sent(seed: int) -> None:
    grid = ObstacleGrid.of(room_mission())
    free = rough_map(grid, seed)
    assert np.array_equal(grid.unpack(grid.pack(free)), free)


def test_a_map_of_an_earlier_release_is_completed_with_what_the_mission_vouches_for() -> None:
    grid = ObstacleGrid.of(room_mission())
    free = rough_map(grid, 1)
    free[grid.vouched] = False
    packed = grid.pack(free)
    assert np.array_equal(grid.read(FreeCells(tick=0, packed=packed)), free | grid.vouched)
    assert np.array_equal(grid.read(FreeCells(tick=0, packed=packed, with_vouched=True)), free)


def test_what_is_not_a_map_of_this_lattice_is_refused() -> None:
    grid = ObstacleGrid.of(room_mission())
    other = ObstacleGrid.of(room_mission(target={"lower_m": (-1.5, -1.5, 0.0), "upper_m": (1.5, 1.5, 1.0)}))
    packed = grid.pack(grid.vouched)
    for rubbish in (b"", b"rubbish", packed[:-8], other.pack(other.vouched), grid.pack(np.zeros(10**7, np.bool_))):
        with pytest.raises(MessageError, match="free cells"):
            grid.unpack(rubbish)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"clear_above_m": 2.9}, "leave nothing to fly in"),
        ({"clear_above_m": -1.0}, "no effect"),
        ({"period_s": 0.01}, "at least a tick"),
        ({"cell_m": 0.01}, "cell_m"),
    ],
)
def test_settings_that_make_no_sense_are_named(changes: dict[str, float], words: str) -> None:
    flight = room_mission().flight.model_dump()
    with pytest.raises(ValidationError, match=words):
        room_mission(flight=flight | {"obstacles": {"enabled": True, **changes}})


def test_a_lattice_that_is_too_fine_for_its_region_is_named() -> None:
    flight = {"lower_m": (-60.0, -60.0, 0.5), "upper_m": (60.0, 60.0, 30.0), "obstacles": {"enabled": True}}
    target = {"lower_m": (-50.0, -50.0, 0.0), "upper_m": (50.0, 50.0, 20.0)}
    with pytest.raises(ValidationError, match="million cells"):
        Mission.model_validate({"flight": flight, "target": target, "drones": [{"id": 1, "start": (0, 0, 25, 0, 1.3)}]})


def test_setpoints_that_may_be_flown_for_too_long_are_named() -> None:
    flight = room_mission().flight.model_dump() | {"setpoint_timeout_s": 1.5}
    with pytest.raises(ValidationError, match="setpoint_timeout_s"):
        room_mission(flight=flight)
