"""What the console draws of drones and of importance, without a browser."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from faults.recorded import team
from ground_station.console.drone_view import Trail, orientation
from ground_station.console.field_view import FieldView, drone_colours, heat
from ground_station.console.free_view import NEAR_M, FreeView
from protocol.errors import MessageError
from protocol.field import VirtualField
from protocol.geometry import camera_rotation
from protocol.importance import ImportanceField
from protocol.messages import FreeCells
from protocol.mission import Flight, Sensing, Target
from protocol.obstacle_settings import Obstacles

SENSING = Sensing()


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.9, math.pi])
@pytest.mark.parametrize("pitch", [0.0, 1.2, math.pi / 2])
def test_the_quaternion_is_the_cameras_rotation(yaw: float, pitch: float) -> None:
    w, *vector = orientation(yaw, pitch)
    x, y, z = vector
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    np.testing.assert_allclose(np.eye(3) + 2 * w * cross + 2 * cross @ cross, camera_rotation(yaw, pitch), atol=1e-12)


def test_a_trail_of_any_length_stays_bounded_and_keeps_both_ends() -> None:
    trail = Trail(step_m=0.05, capacity=100)
    for k in range(20_000):
        trail.add((0.01 * k, 0.0, 1.0))
    points = trail.points
    assert len(points) <= 101
    np.testing.assert_allclose(points[[0, -1], 0], [0.0, 199.99], rtol=1e-6)
    steps = np.diff(points[:-1, 0])
    assert steps.min() >= 0.05
    assert steps.max() < 3 * np.median(steps)


def test_a_drone_that_stands_makes_no_trail() -> None:
    trail = Trail()
    assert trail.segments.shape == (0, 2, 3)
    for _ in range(10):
        trail.add((1.0, 2.0, 3.0))
    assert trail.points.shape == (1, 3)
    assert trail.segments.shape == (0, 2, 3)
    trail.add((1.0, 2.0, 3.01))
    np.testing.assert_allclose(trail.segments, [[(1, 2, 3), (1, 2, 3.01)]])


def test_points_below_the_threshold_are_hidden_and_the_rest_coloured_by_their_mean() -> None:
    field = VirtualField.of(Target())
    view = FieldView(field, SENSING)
    phi = np.zeros(field.shape, np.float32)
    phi[100], phi[200, ::2] = 1.0, 1.0
    cloud = view.by_importance(phi, hide_below=0.1)
    np.testing.assert_allclose(cloud.points, field.positions()[[100, 200]], rtol=1e-6)
    np.testing.assert_array_equal(cloud.colours, heat(np.array([1.0, 0.5])))
    assert len(view.by_importance(phi, hide_below=0.0).points) == field.shape[0]
    assert view.by_importance(phi, hide_below=2.0).points.shape == (0, 3)


def test_a_large_field_is_thinned_evenly_along_every_axis() -> None:
    field = VirtualField.of(Target(cell_m=0.1))
    view = FieldView(field, SENSING, limit=4000)
    cloud = view.by_importance(np.ones(field.shape, np.float32), 0.5)
    assert 1000 < len(cloud.points) <= 4000
    for axis in range(3):
        np.testing.assert_allclose(np.diff(np.unique(cloud.points[:, axis])), view.pitch_m, rtol=1e-3)


def test_the_colours_of_importance_get_lighter_without_a_step() -> None:
    values = np.linspace(-0.5, 2.0, 500)
    colours = heat(values).astype(float)
    luma = colours @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(luma) >= -1).all()
    assert np.abs(np.diff(colours, axis=0)).max() <= 5
    np.testing.assert_array_equal(heat(np.array([1.0])), heat(np.array([7.0])))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_each_drone_owns_as_many_points_as_the_kernel_says(seed: int) -> None:
    field = VirtualField.of(Target(cell_rad=10.0))
    assert field.shape[1] == 1, "with one direction, a point is a cell"
    poses = np.random.default_rng(seed).uniform([-2, -2, 1, -3, 1.1], [2, 2, 2, 3, 1.5], (4, 5))
    colours = drone_colours(range(4))
    cloud = FieldView(field, SENSING).by_owner(np.ones(field.shape, np.float32), 0.0, poses, colours)
    counts = [int((cloud.colours == colour).all(axis=1).sum()) for colour in colours]
    np.testing.assert_allclose(counts, ImportanceField(field, SENSING).owned_cells(poses), atol=1e-6)
    assert min(counts) > 0


def test_the_drone_that_owns_most_directions_colours_a_point() -> None:
    field = VirtualField.of(Target())
    poses = np.array([[-1.5, 0.0, 1.5, 0.0, 1.5], [1.5, 0.0, 1.5, 0.0, 1.5]])
    cloud = FieldView(field, SENSING).by_owner(np.ones(field.shape, np.float32), 0.0, poses, drone_colours([0, 1]))
    below = np.linalg.norm(cloud.points[:, None, :2] - poses[:, :2], axis=2) < 0.3
    for drone in range(2):
        np.testing.assert_array_equal(
            np.unique(cloud.colours[below[:, drone] & (cloud.points[:, 2] < 1)], axis=0), drone_colours([drone])
        )


def test_a_lone_drone_owns_every_point() -> None:
    field = VirtualField.of(Target())
    cloud = FieldView(field, SENSING).by_owner(
        np.ones(field.shape, np.float32), 0.0, np.array([[0.0, 0.0, 2.0, 0.0, 1.5]]), drone_colours([4])
    )
    assert (cloud.colours == drone_colours([4])).all()
    assert len(cloud.points) == field.shape[0]


def test_drones_have_the_palettes_colours_over_and_over() -> None:
    np.testing.assert_array_equal(
        drone_colours([0, 1, 8]), [(0x00, 0x72, 0xB2), (0xD5, 0x5E, 0x00), (0x00, 0x72, 0xB2)]
    )
    assert drone_colours([]).shape == (0, 3)


def among_obstacles() -> tuple[FreeView, NDArray[np.bool_]]:
    """A view that has heard a map, and what is free by it and by the mission."""
    view = FreeView(team().model_copy(update={"flight": Flight(obstacles=Obstacles(enabled=True, cell_m=0.2))}))
    seen = np.random.default_rng(1).random(view.grid.shape) < 0.8
    assert view.take(FreeCells(tick=1, packed=view.grid.pack(seen)))
    return view, seen | view.grid.vouched


def test_a_cut_through_the_free_space_is_the_layer_of_cells_at_its_height() -> None:
    view, free = among_obstacles()
    grid = view.grid
    for level in range(grid.shape[2]):
        height_m = float(grid.origin[2]) + grid.cell_m * (level + 0.3)
        assert view.level(height_m) == level
        cut = view.cut(level)
        np.testing.assert_array_equal(cut.free, free[:, :, level])
        assert abs(cut.height_m - height_m) < grid.cell_m
    assert view.level(-100.0) == 0
    above = view.cut(view.level(100.0))
    assert above.free.all(), "the crew vouches for it"
    assert len(above.borders) == 0
    assert above.height_m > grid.origin[2] + grid.cell_m * grid.shape[2]


def test_each_border_lies_between_a_cell_that_is_free_and_one_that_is_not() -> None:
    view, free = among_obstacles()
    layer = free[:, :, 3]
    borders = view.cut(3).borders
    assert len(borders) == np.diff(layer, axis=0).sum() + np.diff(layer, axis=1).sum()
    middles = borders.mean(axis=1)[:, :2]
    across = np.diff(borders, axis=1)[:, 0, 1::-1]
    np.testing.assert_allclose(np.abs(across).sum(axis=1), view.grid.cell_m, rtol=1e-4)
    sides = [
        layer[tuple(np.floor((middles + sign * across / 2 - view.grid.origin[:2]) / view.grid.cell_m).astype(int).T)]
        for sign in (-1, 1)
    ]
    assert (sides[0] != sides[1]).all()


@pytest.mark.parametrize("seed", range(5))
def test_nothing_that_is_not_free_is_nearer_than_what_is_said_to_be(seed: int) -> None:
    view, free = among_obstacles()
    grid = view.grid
    place = grid.origin + grid.cell_m * np.array(grid.shape) * np.random.default_rng(seed).random(3)
    nearest = view.nearest(place)
    assert nearest is not None
    lows = grid.origin + grid.cell_m * np.argwhere(~free)
    distances = np.linalg.norm(np.clip(place, lows, lows + grid.cell_m) - place, axis=1)
    assert nearest.distance_m == pytest.approx(distances.min())
    assert np.linalg.norm(nearest.point - place) == pytest.approx(nearest.distance_m)
    assert (nearest.low - 1e-9 <= nearest.point).all()
    assert (nearest.point <= nearest.low + grid.cell_m + 1e-9).all()
    assert any(np.allclose(nearest.low, low) for low in lows)


def test_far_above_what_is_not_free_nothing_is_near() -> None:
    view, _ = among_obstacles()
    top_m = float(view.grid.origin[2]) + view.grid.cell_m * view.grid.shape[2]
    assert view.nearest(np.array([0.0, 0.0, top_m + NEAR_M + 0.01])) is None


def test_the_free_space_is_drawn_anew_only_when_it_has_changed() -> None:
    view, free = among_obstacles()
    assert not view.take(None)
    assert not view.take(FreeCells(tick=2, packed=view.grid.pack(free)))
    assert view.take(FreeCells(tick=3, packed=view.grid.pack(np.zeros_like(free))))
    with pytest.raises(MessageError):
        view.take(FreeCells(tick=4, packed=b"rubbish"))
