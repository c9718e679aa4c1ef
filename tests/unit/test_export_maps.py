"""Meshes and clouds, opened with Open3D and, where it speaks of more than Open3D reads, with trimesh."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import open3d
import pytest
import trimesh

from faults.flown import a_flight, a_table_on_a_floor, write_folder
from ground_station.export import meshes as meshes_module
from ground_station.export.maps import export_cloud, export_mesh
from ground_station.export.meshes import cloud_ply, mesh_file, sample
from ground_station.export.source import Source, open_source
from ground_station.reconstruction.reconstructor import Mesh
from protocol.errors import CovreconError

POINTS = 20_000
FLOOR_M2, TABLE_M2 = 36.0, 1.0


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Source:
    return open_source(write_folder(a_flight(), tmp_path_factory.mktemp("run")))


@pytest.fixture(scope="module")
def meshes(source: Source, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("meshes")
    exported = export_mesh(source, folder, ("ply", "glb", "obj"))
    assert exported.content == "8 vertices, 4 triangles as ply, glb, obj"
    return folder


@pytest.mark.parametrize("name", ["mesh.ply", "mesh.obj"])
def test_open3d_reads_mesh_and_colours_in_the_world_frame(meshes: Path, name: str) -> None:
    mesh = open3d.io.read_triangle_mesh(str(meshes / name))
    expected = a_table_on_a_floor()
    np.testing.assert_allclose(np.asarray(mesh.vertices), expected.vertices, atol=1e-6)
    np.testing.assert_array_equal(np.asarray(mesh.triangles), expected.faces)
    np.testing.assert_allclose(np.asarray(mesh.vertex_colors), expected.colors / 255, atol=1e-4)


def test_open3d_reads_glb_with_y_up_as_gltf_demands(meshes: Path) -> None:
    mesh = open3d.io.read_triangle_mesh(str(meshes / "mesh.glb"))
    assert mesh.has_vertex_colors()
    np.testing.assert_allclose(mesh.get_max_bound() - mesh.get_min_bound(), [6.0, 1.0, 6.0])
    assert abs(mesh.get_surface_area() - FLOOR_M2 - TABLE_M2) < 1e-6


def test_trimesh_reads_the_obj_with_its_colours(meshes: Path) -> None:
    mesh = trimesh.load_mesh(meshes / "mesh.obj", process=False)
    np.testing.assert_array_equal(np.asarray(mesh.visual.vertex_colors)[:, :3], a_table_on_a_floor().colors)
    assert abs(mesh.area - FLOOR_M2 - TABLE_M2) < 1e-6


def test_a_mesh_larger_than_one_write_is_whole_in_obj(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(meshes_module, "LINES_AT_ONCE", 100)
    ball = trimesh.creation.icosphere(3)
    colours = np.full((len(ball.vertices), 3), 200, np.uint8)
    mesh = Mesh(ball.vertices.astype(np.float32), ball.faces.astype(np.int32), colours)
    content = io.StringIO(mesh_file(mesh, "obj").decode())
    read = trimesh.load_mesh(content, file_type="obj", process=False)
    np.testing.assert_allclose(read.vertices, mesh.vertices, atol=1e-6)
    np.testing.assert_array_equal(read.faces, mesh.faces)


def test_open3d_reads_the_cloud_spread_evenly_with_normals_and_colours(source: Source, tmp_path: Path) -> None:
    export_cloud(source, tmp_path, POINTS)
    cloud = open3d.io.read_point_cloud(str(tmp_path / "cloud.ply"))
    points, colours = np.asarray(cloud.points), np.asarray(cloud.colors) * 255
    assert len(points) == POINTS
    on_table = np.isclose(points[:, 2], 1.0)
    assert np.isclose(points[~on_table][:, 2], 0.0).all()
    assert abs(on_table.mean() - TABLE_M2 / (FLOOR_M2 + TABLE_M2)) < 1e-3
    quarter = (points[:, 0] < 0) & (points[:, 1] < 0) & ~on_table
    assert abs(quarter.sum() / (~on_table).sum() - 0.25) < 0.01
    np.testing.assert_allclose(np.asarray(cloud.normals), np.broadcast_to([0.0, 0.0, 1.0], points.shape))
    np.testing.assert_allclose(colours[on_table], np.broadcast_to([200, 40, 40], (on_table.sum(), 3)), atol=0.5)
    np.testing.assert_allclose(colours[~on_table], np.broadcast_to([40, 60, 200], ((~on_table).sum(), 3)), atol=0.5)


def test_the_same_map_gives_the_same_cloud() -> None:
    mesh = a_table_on_a_floor()
    assert cloud_ply(sample(mesh, 1000)) == cloud_ply(sample(mesh, 1000))


def test_triangles_without_area_get_no_points() -> None:
    table = a_table_on_a_floor()
    faces = np.vstack([[[0, 0, 1]], table.faces, [[2, 2, 2]]]).astype(np.int32)
    points = sample(Mesh(table.vertices, faces, table.colors), 1000)
    assert all(np.isfinite(points[name]).all() for name in ("x", "y", "z", "nx", "ny", "nz"))


@pytest.mark.parametrize("faces", [np.empty((0, 3), np.int32), np.zeros((2, 3), np.int32)])
def test_a_map_without_area_has_no_cloud(faces: np.ndarray) -> None:
    table = a_table_on_a_floor()
    with pytest.raises(CovreconError, match="no area"):
        sample(Mesh(table.vertices, faces, table.colors), 10)
