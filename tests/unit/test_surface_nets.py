from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from ground_station.reconstruction.fusion import Volume
from ground_station.reconstruction.surface_nets import extract_mesh
from protocol.geometry import Floats
from protocol.mission import Box

RADIUS = 0.4
VOXEL = 0.05
CENTRE = (0.011, 0.007, 0.513)
"""Off the grid."""


def points_of(volume: Volume) -> Floats:
    points: Floats = volume.origin + volume.voxel * np.moveaxis(np.indices(volume.distance.shape), 0, -1)
    return points


@pytest.fixture
def sphere() -> Volume:
    volume = Volume(Box(lower_m=(-0.5, -0.5, 0.0), upper_m=(0.5, 0.5, 1.0)), VOXEL, 2 * VOXEL)
    away = np.linalg.norm(points_of(volume) - CENTRE, axis=-1) - RADIUS
    volume.distance[:] = np.clip(away, -volume.truncation, volume.truncation)
    volume.weight[:] = 1.0
    volume.color[:] = (200, 100, 50)
    return volume


def test_a_sphere_becomes_a_closed_mesh_closer_to_it_than_a_tenth_of_a_voxel(sphere: Volume) -> None:
    mesh = extract_mesh(sphere, 0.5)
    edges = Counter(
        (int(first), int(second)) for face in mesh.faces for first, second in zip(face, np.roll(face, -1), strict=True)
    )
    assert all(count == 1 and edges[second, first] == 1 for (first, second), count in edges.items())
    assert len(mesh.vertices) - len(edges) // 2 + len(mesh.faces) == 2  # Euler: one piece without holes
    error = np.abs(np.linalg.norm(mesh.vertices - CENTRE, axis=1) - RADIUS)
    assert error.max() < 0.15 * VOXEL
    assert (mesh.colors == (200, 100, 50)).all()


def test_faces_turn_their_front_to_where_the_distance_is_positive(sphere: Volume) -> None:
    mesh = extract_mesh(sphere, 0.5)
    first, second, third = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    normals = np.cross(second - first, third - first)
    assert (np.sum(normals * (first - CENTRE), axis=1) > 0).all()


def test_the_surface_ends_where_the_observation_ends(sphere: Volume) -> None:
    sphere.weight[points_of(sphere)[..., 0] > 0.1] = 0.0
    mesh = extract_mesh(sphere, 0.5)
    assert len(mesh.faces) > 100
    assert mesh.vertices[:, 0].max() <= 0.1 + 1e-6


def test_every_vertex_belongs_to_the_cell_it_lies_in(sphere: Volume) -> None:
    mesh = extract_mesh(sphere, 0.5)
    cells = np.floor((mesh.vertices - sphere.origin) / VOXEL)
    assert len(np.unique(cells, axis=0)) == len(mesh.vertices)


def test_a_volume_that_saw_nothing_has_an_empty_mesh() -> None:
    mesh = extract_mesh(Volume(Box(lower_m=(0, 0, 0), upper_m=(1, 1, 1)), VOXEL, 2 * VOXEL), 0.5)
    assert (mesh.vertices.shape, mesh.faces.shape, mesh.colors.shape) == ((0, 3), (0, 3), (0, 3))
