"""What the console draws of drones and of importance, without a browser."""

import math

import numpy as np
import pytest

from ground_station.console.drone_view import Trail, orientation
from ground_station.console.field_view import FieldView, drone_colours, heat
from protocol.field import VirtualField
from protocol.geometry import camera_rotation
from protocol.importance import ImportanceField
from protocol.mission import Sensing, Target

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
