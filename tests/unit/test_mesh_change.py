"""Map feedback of eq. (5): counts against brute force, the factorised sum against the dense formula. What holds for all
kinds of feedback is in tests/contract/test_mesh_changes.py."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from faults.meshes import of_points
from ground_station.mesh_change import GridMeshChange, count_vertices
from protocol.field import VirtualField, cell_centres
from protocol.geometry import Floats
from protocol.map_settings import Feedback
from protocol.mission import Target

TARGET = Target(lower_m=(-1.0, -0.8, 0.0), upper_m=(1.1, 0.8, 0.9))
FIELD = VirtualField.of(TARGET)
AXES = (FIELD.xs, FIELD.ys, FIELD.zs)
Normalisation = Literal["sum", "mean"]


def grid_points(spacing_m: float) -> Floats:
    axes = [cell_centres(low, high, spacing_m) for low, high in zip(TARGET.lower_m, TARGET.upper_m, strict=True)]
    return np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")], axis=1)


def vertices_in_and_around_the_target(seed: int, count: int = 400) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform(np.array(TARGET.lower_m) - 0.2, np.array(TARGET.upper_m) + 0.2, (count, 3)).astype(np.float32)


def inside(vertices: np.ndarray) -> np.ndarray:
    return np.asarray(np.all((vertices >= TARGET.lower_m) & (vertices <= TARGET.upper_m), axis=1))


def nearest_counts(vertices: np.ndarray, points: Floats) -> np.ndarray:
    distances = np.linalg.norm(vertices[inside(vertices), None, :].astype(float) - points[None], axis=2)
    return np.bincount(distances.argmin(axis=1), minlength=len(points))


def dense_h2(before: np.ndarray, after: np.ndarray, feedback: Feedback) -> Floats:
    points = grid_points(feedback.spacing_m)
    change = nearest_counts(after, points) - nearest_counts(before, points)
    squared = ((FIELD.positions()[:, None, :] - points[None]) ** 2).sum(axis=2)
    kernel = np.exp(-squared / (2 * feedback.kernel_m**2))
    total: Floats = kernel @ np.tanh((change / feedback.kappa) ** 2) ** 2
    return total / kernel.sum(axis=1) if feedback.normalisation == "mean" else total


@pytest.mark.parametrize("normalisation", ["sum", "mean"])
@pytest.mark.parametrize("spacing_m", [0.3, 0.17])
def test_the_factorised_sum_equals_the_dense_formula(normalisation: Normalisation, spacing_m: float) -> None:
    feedback = Feedback(normalisation=normalisation, spacing_m=spacing_m)
    change = GridMeshChange(TARGET, feedback, AXES)
    before, after = vertices_in_and_around_the_target(1, 90), vertices_in_and_around_the_target(2, 120)
    change.update(of_points(before))
    got = change.update(of_points(after))
    assert got.dtype == np.float32
    assert got.shape == (FIELD.shape[0],)
    np.testing.assert_allclose(got, dense_h2(before, after, feedback), rtol=1e-6, atol=1e-6)


def test_the_first_mesh_is_compared_with_an_empty_one() -> None:
    vertices = vertices_in_and_around_the_target(3)
    got = GridMeshChange(TARGET, Feedback(), AXES).update(of_points(vertices))
    np.testing.assert_allclose(got, dense_h2(vertices[:0], vertices, Feedback()), rtol=1e-6, atol=1e-6)


def test_feedback_is_strongest_where_the_mesh_changed() -> None:
    corner = np.array([[FIELD.xs[-1], FIELD.ys[0], FIELD.zs[1]]], np.float32)
    change = GridMeshChange(TARGET, Feedback(), AXES).update(of_points(corner))
    np.testing.assert_allclose(FIELD.positions()[change.argmax()], corner[0], atol=1e-6)


@given(
    arrays(
        np.float32,
        st.tuples(st.integers(0, 60), st.just(3)),
        elements=st.floats(-1.25, 1.25, width=32, allow_nan=False),
    )
)
@settings(max_examples=60, deadline=None)
def test_every_vertex_in_the_target_counts_once_at_a_nearest_point(vertices: np.ndarray) -> None:
    spacing = 0.3
    axes = [cell_centres(low, high, spacing) for low, high in zip(TARGET.lower_m, TARGET.upper_m, strict=True)]
    shape = (len(axes[0]), len(axes[1]), len(axes[2]))
    lower, upper = np.array(TARGET.lower_m), np.array(TARGET.upper_m)
    total = np.zeros(shape, int)
    for vertex in vertices:
        counts = count_vertices(vertex[None], lower, upper, shape)
        assert counts.sum() == inside(vertex[None])[0]
        for cell in np.argwhere(counts):
            for axis, index, value in zip(axes, cell, vertex.astype(float), strict=True):
                assert abs(axis[index] - value) <= np.abs(axis - value).min() + 1e-9
        total += counts
    np.testing.assert_array_equal(count_vertices(vertices, lower, upper, shape), total)


def test_counts_equal_brute_force_away_from_ties() -> None:
    vertices = vertices_in_and_around_the_target(6, 2000)
    lower, upper = np.array(TARGET.lower_m), np.array(TARGET.upper_m)
    counts = count_vertices(vertices, lower, upper, (7, 5, 3))
    np.testing.assert_array_equal(counts.ravel(), nearest_counts(vertices, grid_points(0.3)))


def test_on_a_lattice_with_many_ties_counts_equal_the_dense_formula() -> None:
    """As on voxel edges. Binary fractions, so that no distance is rounded; the last of the nearest points wins."""
    lower, upper, spacing, voxel = np.zeros(3), np.array([2.0, 1.5, 1.0]), 0.25, 0.0625
    lattice = np.stack(np.meshgrid(*(np.arange(0, high + voxel, voxel) for high in upper), indexing="ij"), axis=-1)
    vertices = lattice.reshape(-1, 3).astype(np.float32)
    axes = [cell_centres(0, high, spacing) for high in upper]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    squared = ((vertices[:, None, :].astype(float) - points[None]) ** 2).sum(axis=2)
    nearest = squared.min(axis=1, keepdims=True)
    assert ((squared == nearest).sum(axis=1) > 1).mean() > 0.4
    dense = np.bincount(len(points) - 1 - (squared == nearest)[:, ::-1].argmax(axis=1), minlength=len(points))

    counts = count_vertices(vertices, lower, upper, (8, 6, 4))

    np.testing.assert_array_equal(counts.ravel(), dense)


def test_a_vertex_midway_between_two_points_counts_for_the_larger_coordinate() -> None:
    lower, upper = np.zeros(3), np.ones(3)
    midway = np.array([[0.5, 0.25, 0.75]], np.float32)
    assert np.argwhere(count_vertices(midway, lower, upper, (2, 4, 4))).tolist() == [[1, 1, 3]]


def test_the_targets_faces_belong_to_it_and_nan_does_not() -> None:
    lower, upper = np.zeros(3), np.ones(3)
    vertices = np.array([[1, 1, 1], [0, 0, 0], [np.nan, 0.5, 0.5], [0.5, 0.5, 1.001]], np.float32)
    counts = count_vertices(vertices, lower, upper, (2, 2, 2))
    assert counts.sum() == counts[0, 0, 0] + counts[1, 1, 1] == 2


def test_mean_feedback_never_exceeds_one_even_with_a_kernel_narrower_than_the_grid() -> None:
    everywhere = np.repeat(grid_points(0.3), 9, axis=0).astype(np.float32)
    for kernel_m in (0.4, 1e-4):
        h2 = GridMeshChange(TARGET, Feedback(kernel_m=kernel_m, spacing_m=0.3), AXES).update(of_points(everywhere))
        assert 0.99 < h2.min() <= h2.max() <= 1


@pytest.mark.parametrize(("length_m", "spacing_m", "cells"), [(6.0, 0.3, 20), (2.0, 0.3, 7), (0.1, 0.3, 1)])
def test_the_grid_divides_the_target_evenly(length_m: float, spacing_m: float, cells: int) -> None:
    axis = cell_centres(-1.0, length_m - 1.0, spacing_m)
    assert len(axis) == cells
    np.testing.assert_allclose([axis[0] + 1, length_m - 1 - axis[-1]], length_m / cells / 2)
