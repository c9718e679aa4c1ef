"""Posed images, opened by those who read them: COLMAP's own library, and nerfstudio's definition of a camera."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from PIL import Image

from faults.flown import CAMERAS, HEIGHT, MARK, ORIGIN, WIDTH, Flown, a_flight, spot_in, write_folder
from ground_station.export.colmap import export_colmap
from ground_station.export.nerfstudio import export_nerfstudio
from ground_station.export.source import Source, open_source
from protocol.depth_image import encode_depth
from protocol.errors import CovreconError

SPOT_ERROR_PX = 0.1
"""Of finding a spot in a JPEG; half a pixel would be a wrong convention."""
POINTS = 500
SPHERE_ERROR = 0.007
"""PX4's sphere against the ellipsoid."""


@pytest.fixture(scope="module")
def flown() -> Flown:
    return a_flight(ORIGIN)


@pytest.fixture(scope="module")
def source(flown: Flown, tmp_path_factory: pytest.TempPathFactory) -> Source:
    return open_source(write_folder(flown, tmp_path_factory.mktemp("run")))


@pytest.fixture(scope="module")
def model(source: Source, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("colmap")
    export_colmap(source, folder, points=POINTS)
    return folder


@pytest.fixture(scope="module")
def scene(source: Source, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("nerfstudio")
    export_nerfstudio(source, folder, points=POINTS)
    return folder


def test_colmap_opens_the_model_and_sees_a_known_point_where_it_is_in_each_image(model: Path, flown: Flown) -> None:
    reconstruction = pycolmap.Reconstruction(model / "sparse/0")
    assert reconstruction.num_reg_images() == len(flown.keyframes)
    assert reconstruction.num_cameras() == len(CAMERAS)
    for image in reconstruction.images.values():
        assert image.camera.model == pycolmap.CameraModelId.PINHOLE
        spot = spot_in(model / "images" / image.name)
        np.testing.assert_allclose(image.project_point(MARK), spot, atol=SPOT_ERROR_PX)


def test_colmap_has_every_digit_of_poses_and_cameras(model: Path, flown: Flown) -> None:
    reconstruction = pycolmap.Reconstruction(model / "sparse/0")
    images = {image.name: image for image in reconstruction.images.values()}
    for keyframe in flown.keyframes:
        image = images[f"drone_{keyframe.drone}_{keyframe.sequence:06d}.jpg"]
        np.testing.assert_allclose(image.projection_center(), keyframe.position, atol=1e-12)
        rotation = image.cam_from_world().rotation.matrix().T
        np.testing.assert_allclose(rotation, keyframe.rotation, atol=1e-12)
        assert tuple(image.camera.params) == CAMERAS[keyframe.drone]
        assert (image.camera.width, image.camera.height) == (WIDTH, HEIGHT)


def test_colmap_opens_points_of_the_map(model: Path, flown: Flown) -> None:
    points = pycolmap.Reconstruction(model / "sparse/0").points3D
    assert len(points) == POINTS
    heights = {round(float(point.xyz[2]), 5) for point in points.values()}
    assert heights == {0.0, 1.0}
    colours = {tuple(point.color) for point in points.values()}
    assert colours == {tuple(colour) for colour in flown.mesh.colors}


def test_colmap_finds_the_scale_and_place_of_a_georeferenced_model(model: Path) -> None:
    reconstruction = pycolmap.Reconstruction(model / "sparse/0")
    rows = [line.split() for line in (model / "geo.txt").read_text().splitlines()]
    assert {row[0] for row in rows} == {image.name for image in reconstruction.images.values()}
    places = np.array([[float(cell) for cell in row[1:]] for row in rows])
    metres = pycolmap.GPSTransform().ellipsoid_to_enu(places, *ORIGIN)
    flown = np.array([reconstruction.find_image_with_name(row[0]).projection_center() for row in rows])
    distances = np.linalg.norm(metres[:, :2], axis=1)
    assert distances.min() > 0.1
    error = np.linalg.norm(metres[:, :2] - flown[:, :2], axis=1)
    assert (error < SPHERE_ERROR * distances).all()
    np.testing.assert_allclose(places[:, 2], ORIGIN[2] + flown[:, 2], atol=1e-4)


def frames(scene: Path) -> list[dict[str, Any]]:
    loaded: list[dict[str, Any]] = json.loads((scene / "transforms.json").read_text())["frames"]
    return loaded


def test_nerfstudio_sees_a_known_point_where_it_is_in_each_image(scene: Path, flown: Flown) -> None:
    """A camera of nerfstudio looks along -z, x is right and y up; pixel centres are at halves."""
    assert len(frames(scene)) == len(flown.keyframes)
    for frame in frames(scene):
        x, y, z, _ = np.linalg.inv(frame["transform_matrix"]) @ [*MARK, 1]
        seen = [frame["cx"] + frame["fl_x"] * x / -z, frame["cy"] - frame["fl_y"] * y / -z]
        np.testing.assert_allclose(seen, spot_in(scene / frame["file_path"]), atol=SPOT_ERROR_PX)


def test_nerfstudio_and_colmap_are_told_the_same(scene: Path, model: Path) -> None:
    reconstruction = pycolmap.Reconstruction(model / "sparse/0")
    for frame in frames(scene):
        image = reconstruction.find_image_with_name(Path(frame["file_path"]).name)
        from_opengl = np.linalg.inv(np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1]))
        np.testing.assert_allclose(image.cam_from_world().matrix(), from_opengl[:3], atol=1e-12)
        fx, fy, cx, cy = image.camera.params
        assert (frame["fl_x"], frame["fl_y"], frame["cx"], frame["cy"]) == (fx, fy, cx, cy)
        assert (frame["w"], frame["h"]) == (image.camera.width, image.camera.height)


def test_nerfstudio_is_given_points_of_the_map_and_keeps_the_world_upright(scene: Path) -> None:
    content = json.loads((scene / "transforms.json").read_text())
    assert content["orientation_override"] == "none"
    assert (scene / content["ply_file_path"]).stat().st_size > POINTS


def test_images_are_those_that_the_drones_sent(scene: Path, flown: Flown) -> None:
    for keyframe in flown.keyframes:
        assert (scene / f"images/drone_{keyframe.drone}_{keyframe.sequence:06d}.jpg").read_bytes() == keyframe.jpeg


def test_the_same_run_gives_the_same_bytes(source: Source, scene: Path, model: Path, tmp_path: Path) -> None:
    for export, first in ((export_nerfstudio, scene), (export_colmap, model)):
        folder = tmp_path / first.name
        folder.mkdir()
        export(source, folder, points=POINTS)
        files = [file.relative_to(first) for file in first.rglob("*") if file.is_file()]
        assert files
        for file in files:
            assert (folder / file).read_bytes() == (first / file).read_bytes()


def test_keyframes_that_nobody_can_use_are_left_out_and_counted(flown: Flown, tmp_path: Path) -> None:
    good, other, *_ = flown.keyframes
    torn = other.jpeg[: len(other.jpeg) // 2]
    huge = {"width": 8000, "height": 8000}
    bad = [
        good.model_copy(update={"tick": 1}),
        other.model_copy(update={"sequence": 90, "jpeg": torn}),
        other.model_copy(update={"sequence": 91, "jpeg": b"no image"}),
        other.model_copy(update={"sequence": 92, **huge}),
        other.model_copy(update={"sequence": 93, "rotation": ((1.0, 0.0, 0.0),) * 3}),
        other.model_copy(update={"sequence": 94, "rotation": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0))}),
    ]
    run = write_folder(dataclasses.replace(flown, keyframes=(good, *bad)), tmp_path / "run")
    exported = export_colmap(open_source(run), tmp_path, points=0)
    assert pycolmap.Reconstruction(tmp_path / "sparse/0").num_images() == 1
    assert exported.notes == (
        "left out: 2 of the keyframes: damaged",
        "left out: 2 of the keyframes: no rotation",
        "left out: 1 of the keyframes: of another size than its camera",
        "left out: 1 of the keyframes: seen before",
    )
    assert [file.name for file in (tmp_path / "images").iterdir()] == ["drone_1_000000.jpg"]


def test_an_image_that_would_fill_the_memory_is_left_out(
    flown: Flown, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", WIDTH * HEIGHT - 1)
    source = open_source(write_folder(flown, tmp_path / "run"))
    with pytest.raises(CovreconError, match="no keyframe that can be exported"):
        export_nerfstudio(source, tmp_path, points=0)


def test_a_run_without_a_map_is_exported_without_points(flown: Flown, tmp_path: Path) -> None:
    source = open_source(write_folder(flown, tmp_path / "run", finished=False))
    exported = export_nerfstudio(source, tmp_path, points=POINTS)
    assert "ply_file_path" not in json.loads((tmp_path / "transforms.json").read_text())
    assert any("without points" in note and "mesh.ply" in note for note in exported.notes)
    folder = tmp_path / "colmap"
    folder.mkdir()
    export_colmap(source, folder, points=POINTS)
    assert not pycolmap.Reconstruction(folder / "sparse/0").points3D


def test_what_depth_cameras_measured_is_exported_in_millimetres_where_all_images_have_it(tmp_path: Path) -> None:
    flown = a_flight(ORIGIN)
    depth = encode_depth(np.full((HEIGHT // 2, WIDTH // 2), 1.25, np.float32))
    deep = tuple(one.model_copy(update={"depth": depth}) for one in flown.keyframes)
    for name, keyframes in (("all", deep), ("some", (*deep[:-1], flown.keyframes[-1]))):
        (tmp_path / name).mkdir()
        run = write_folder(dataclasses.replace(flown, keyframes=keyframes), tmp_path / name)
        folder = tmp_path / f"{name}-scene"
        folder.mkdir()
        export_nerfstudio(open_source(run), folder, points=POINTS)
        found = [frame.get("depth_file_path", "") for frame in frames(folder)]
        assert all(found) if name == "all" else not any(found)
        if name == "all":
            with Image.open(folder / found[0]) as image:
                assert np.asarray(image).tolist() == np.full((HEIGHT // 2, WIDTH // 2), 1250).tolist()
