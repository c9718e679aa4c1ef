"""Cells that a volume has seen free: all of their voxels seen, and none at or behind a surface."""

from __future__ import annotations

import math

import numpy as np
import pytest

from faults.seen_room import room_mission
from ground_station.reconstruction.free_cells import free_cells
from ground_station.reconstruction.fusion import Volume
from ground_station.reconstruction.views import View
from protocol.geometry import Floats, Intrinsics, camera_rotation
from protocol.obstacle_grid import Cells, ObstacleGrid

MISSION = room_mission()
GRID = ObstacleGrid.of(MISSION)
GRID.vouched[:] = False
WEIGHT_MIN = 0.3
EMPTY = Volume(MISSION.target, 0.025, 0.05)
CAMERA = Intrinsics.from_field_of_view(96, 54, 1.28)
HEIGHT_M = 2.2


def look_down(table_m: float = 0.0, place: Floats | None = None) -> Volume:
    """What one look straight down sees of a floor at z = 0, with a table of that height where y > 0."""
    volume = Volume(MISSION.target, 0.025, 0.05)
    position = np.array([0.0, 0.0, HEIGHT_M]) if place is None else place
    rotation = camera_rotation(0.0, math.pi / 2)
    pixels = np.stack([*np.meshgrid(np.arange(96), np.arange(54)), np.ones((54, 96))], axis=-1)
    view = View(np.zeros((54, 96), np.uint8), position, rotation, CAMERA)
    rays = pixels @ np.linalg.inv(view.calibration).T @ rotation.T
    depth = np.full((54, 96), position[2], np.float32)
    if table_m:
        on_table = position[1] + rays[..., 1] * (position[2] - table_m) > 0
        depth[on_table] -= np.float32(table_m)
    volume.integrate(view, depth, np.ones((54, 96), np.float32), np.full((54, 96, 3), 128, np.uint8))
    return volume


def centres_of(cells: Cells) -> Floats:
    return np.asarray(GRID.origin + GRID.cell_m * (np.argwhere(cells) + 0.5))


def test_nothing_is_free_that_was_never_seen() -> None:
    assert not free_cells(EMPTY, WEIGHT_MIN, GRID).any()


def test_what_was_seen_through_is_free_down_to_the_floor() -> None:
    free = centres_of(free_cells(look_down(), WEIGHT_MIN, GRID))

    assert len(free) > 1000
    assert free[:, 2].min() == pytest.approx(0.15), "the cell on the floor holds the surface"
    # 96 x 54 pixels of 73 degrees: within these angles of the axis, and a cell's half diagonal in from the edge.
    shares = np.abs(free[:, :2] - [0.0, 0.0]) / (HEIGHT_M - free[:, 2:])
    assert shares.max() < math.tan(1.28 / 2)


def test_what_is_behind_a_surface_or_at_it_is_not_free() -> None:
    volume = look_down(table_m=0.65)
    free = centres_of(free_cells(volume, WEIGHT_MIN, GRID))

    above_table = free[free[:, 1] > 0.05]
    assert above_table[:, 2].min() == pytest.approx(0.75, abs=0.051)
    assert free[free[:, 1] < -0.2][:, 2].min() == pytest.approx(0.15)


def test_one_look_that_weighs_too_little_frees_nothing() -> None:
    volume = look_down()
    volume.weight *= np.float32(0.1)
    assert not free_cells(volume, WEIGHT_MIN, GRID).any()


def test_a_single_voxel_at_a_surface_keeps_its_cell() -> None:
    volume = look_down()
    before = free_cells(volume, WEIGHT_MIN, GRID)
    cell = np.argwhere(before)[len(np.argwhere(before)) // 2]
    middle = GRID.origin + GRID.cell_m * (cell + 0.5)
    voxel = np.rint((middle - volume.origin) / volume.voxel).astype(int)
    volume.distance[tuple(voxel)] = 0.01

    after = free_cells(volume, WEIGHT_MIN, GRID)

    assert np.argwhere(before & ~after).tolist() == [cell.tolist()]


def test_cells_of_another_size_than_voxels_divide_are_seen_as_well() -> None:
    flight = MISSION.flight.model_dump() | {"obstacles": {"enabled": True, "cell_m": 0.13}}
    grid = ObstacleGrid.of(room_mission(flight=flight))
    grid.vouched[:] = False
    free = free_cells(look_down(), WEIGHT_MIN, grid)
    low = grid.origin + grid.cell_m * np.argwhere(free)
    assert len(low) > 300
    assert low[:, 2].min() > 0.02


def test_what_the_mission_vouches_for_is_free_until_something_is_seen_in_it() -> None:
    over_table, unseen = (0.3, 0.6, 1.0), (-1.4, -1.4, 1.0)
    grid = ObstacleGrid.of(room_mission([over_table, unseen]))
    assert np.array_equal(free_cells(EMPTY, WEIGHT_MIN, grid), grid.vouched)

    free = free_cells(look_down(table_m=0.65), WEIGHT_MIN, grid)

    taken = centres_of(grid.vouched & ~free)
    assert len(taken) > 20, "the table is nearer than the crew thought"
    assert (np.hypot(*(taken[:, :2] - over_table[:2]).T) < 0.5).all()
    assert taken[:, 2].max() < 0.65 + GRID.cell_m
    around_unseen = grid.vouched[: grid.shape[0] // 2]
    assert around_unseen.any()
    assert free[: grid.shape[0] // 2][around_unseen].all(), "and nobody knows better there"


def test_where_a_vehicle_took_off_from_the_ground_it_may_land_whatever_is_seen() -> None:
    mission = room_mission([(0.5, 0.5, 1.5)], vehicles={"kind": "px4"})
    grid = ObstacleGrid.of(mission)
    volume = look_down(table_m=0.65)

    free = free_cells(volume, WEIGHT_MIN, grid)

    assert grid.stood_on.any()
    assert not (grid.stood_on & ~grid.vouched).any()
    assert free[grid.stood_on].all()
