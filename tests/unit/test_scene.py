import logging
import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from protocol.errors import SceneError
from protocol.geometry import Intrinsics
from sim_bridge.camera import Camera
from sim_bridge.scenes.lighting import bake
from sim_bridge.scenes.living_room import living_room
from sim_bridge.scenes.scene import build_scene, load_scene
from sim_bridge.scenes.surfaces import Material, Surfaces, box, cushion, join, lathe, quad, rod
from sim_bridge.scenes.texture_set import build_texture_set, with_contrast

INTRINSICS = Intrinsics.from_field_of_view(160, 90, math.radians(73.7))
FROM_ABOVE = (0.0, 0.0, 3.0, math.pi / 2, math.pi / 2)
"""North is up in the image."""
WHITE = [np.full((1, 1, 3), 255, np.uint8)]


def area(surfaces: Surfaces) -> float:
    t = surfaces.triangles
    return float(np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1).sum() / 2)


def volume(surfaces: Surfaces) -> float:
    """Signed; positive if a closed surface faces outwards."""
    t = surfaces.triangles
    return float(np.einsum("ij,ij->i", t[:, 0], np.cross(t[:, 1], t[:, 2])).sum() / 6)


def stage() -> Surfaces:
    """A floor of 4 x 4 m with a cube of 0.8 m."""
    ground = quad([(-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0)], Material(0))
    return join([ground, box((0.8, 0.8, 0.8), Material(0), without="z")])


def write_cube(path: Path, colour: tuple[int, int, int, int] = (200, 40, 40, 255)) -> Path:
    cube = trimesh.creation.box((1.0, 1.0, 1.0))
    cube.visual.vertex_colors = np.tile(np.array(colour, np.uint8), (8, 1))
    cube.export(path)
    return path


def load(spec: str, folder: Path) -> np.ndarray:
    """Photograph from above of the scene ``spec``."""
    return Camera(load_scene(spec, relative_to=folder, cache=folder / "cache"), INTRINSICS).render(FROM_ABOVE)


def test_a_name_that_is_neither_built_in_nor_a_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"ballroom.*no such scene"):
        load("ballroom", tmp_path)


@pytest.mark.parametrize("suffix", ["glb", "gltf", "obj", "ply", "stl"])
def test_a_file_of_rubbish_is_refused_by_name(tmp_path: Path, suffix: str) -> None:
    (tmp_path / f"broken.{suffix}").write_bytes(b"\x00\x13rubbish\xff" * 30)
    with pytest.raises(SceneError, match=rf"broken\.{suffix}"):
        load(f"broken.{suffix}", tmp_path)


def test_a_file_of_another_kind_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("a room")
    with pytest.raises(SceneError, match=r"notes\.txt: not a mesh"):
        load("notes.txt", tmp_path)


@pytest.mark.parametrize(("name", "line"), [("nan", "v nan 0 0"), ("infinite", "v 1e999 0 0")])
def test_vertices_that_are_not_finite_are_refused(tmp_path: Path, name: str, line: str) -> None:
    (tmp_path / f"{name}.obj").write_text(f"{line}\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(SceneError, match=rf"{name}\.obj"):
        load(f"{name}.obj", tmp_path)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\n", "triangles"),
        ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "area"),
        ("v 0 0 0\nv 9000 0 0\nv 0 1 0\nf 1 2 3\n", "unit"),
        ("v 0 0 0\nv 0.001 0 0\nv 0 0.001 0\nf 1 2 3\n", "unit"),
    ],
)
def test_a_mesh_that_cannot_be_photographed_is_refused(tmp_path: Path, text: str, reason: str) -> None:
    (tmp_path / "odd.obj").write_text(text)
    with pytest.raises(SceneError, match=rf"odd\.obj.*{reason}"):
        load("odd.obj", tmp_path)


def test_a_folder_must_hold_exactly_one_mesh(tmp_path: Path) -> None:
    room = tmp_path / "room"
    room.mkdir()
    with pytest.raises(SceneError, match=r"room.*exactly one.*none"):
        load("room", tmp_path)
    write_cube(room / "a.ply")
    assert load("room", tmp_path).std() > 5
    write_cube(room / "b.ply")
    with pytest.raises(SceneError, match=r"found a\.ply, b\.ply"):
        load("room", tmp_path)


def test_a_textured_glb_is_turned_z_up_and_shows_its_picture(tmp_path: Path) -> None:
    # Ground of 2 x 2 m, west half red, east half blue, and a green cube in the north-east: in glTF's axes
    # (x, y, z) = (east, up, south).
    picture = np.zeros((8, 8, 3), np.uint8)
    picture[:, :4], picture[:, 4:] = (220, 20, 20), (20, 20, 220)
    visual = trimesh.visual.TextureVisuals(
        uv=np.array([[0, 0], [1, 0], [1, 1], [0, 1]]),
        material=trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(picture)),
    )
    corners = np.array([[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]], dtype=float)
    ground = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)
    green = trimesh.creation.box((0.3, 0.3, 0.3))
    green.visual.vertex_colors = np.tile(np.array((20, 220, 20, 255), np.uint8), (8, 1))
    both = trimesh.Scene([ground])
    both.add_geometry(green, transform=trimesh.transformations.translation_matrix([0.6, 0.15, -0.6]))
    both.export(tmp_path / "user.glb")
    scene = load_scene("user.glb", relative_to=tmp_path, cache=tmp_path / "cache")
    assert scene.triangles[..., 2].min() == pytest.approx(0.0, abs=1e-6)
    assert scene.triangles[..., 2].max() == pytest.approx(0.3, abs=1e-6)
    image = Camera(scene, INTRINSICS).render(FROM_ABOVE).astype(int)
    scale = INTRINSICS.fx / 3.0
    for east, north, channel in ((-0.5, -0.5, 0), (-0.5, 0.5, 0), (0.5, -0.5, 2)):
        pixel = image[round(INTRINSICS.cy - north * scale), round(INTRINSICS.cx + east * scale)]
        assert pixel.argmax() == channel
    scale = INTRINSICS.fx / 2.7
    assert image[round(INTRINSICS.cy - 0.6 * scale), round(INTRINSICS.cx + 0.6 * scale)].argmax() == 1


def test_an_obj_brings_the_picture_that_its_material_names(tmp_path: Path) -> None:
    Image.fromarray(np.full((4, 4, 3), (30, 210, 30), np.uint8)).save(tmp_path / "paint.png")
    (tmp_path / "room.mtl").write_text("newmtl paint\nKd 0.2 0.2 0.2\nmap_Kd paint.png\n")
    corners = "v -2 -2 0\nv 2 -2 0\nv 2 2 0\nv -2 2 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    faces = "usemtl paint\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
    (tmp_path / "room.obj").write_text("mtllib room.mtl\n" + corners + faces)
    image = load("room.obj", tmp_path)
    assert image[45, 80].argmax() == 1
    assert image[45, 80, 1] > 4 * image[45, 80, 0]


def test_vertex_colours_of_a_ply_are_shown_and_a_plain_stl_is_grey(tmp_path: Path) -> None:
    write_cube(tmp_path / "red.ply")
    red = load("red.ply", tmp_path)[45, 80].astype(int)
    assert red[0] > 3 * max(red[1], red[2])
    trimesh.creation.box((1.0, 1.0, 1.0)).export(tmp_path / "plain.stl")
    grey = load("plain.stl", tmp_path)[45, 80].astype(int)
    assert np.ptp(grey) < 30
    assert grey.min() > 60


def test_a_scene_is_built_once_and_the_same_when_read_again(tmp_path: Path) -> None:
    write_cube(tmp_path / "cube.ply")
    told: list[str] = []
    cache = tmp_path / "cache"
    built = load_scene("cube.ply", relative_to=tmp_path, cache=cache, on_progress=told.append)
    assert any("building" in line for line in told)
    told.clear()
    read = load_scene("cube.ply", relative_to=tmp_path, cache=cache, on_progress=told.append)
    assert not any("building" in line for line in told)
    assert read.fingerprint == built.fingerprint
    assert np.array_equal(read.light, built.light)
    assert [path.suffix for path in cache.iterdir()] == [".npz"]


def test_a_damaged_cache_is_reported_and_built_again(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_cube(tmp_path / "cube.ply")
    cache = tmp_path / "cache"
    built = load_scene("cube.ply", relative_to=tmp_path, cache=cache)
    (kept,) = cache.iterdir()
    for damage in (kept.read_bytes()[: kept.stat().st_size // 2], b"", b"rubbish"):
        kept.write_bytes(damage)
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            assert load_scene("cube.ply", relative_to=tmp_path, cache=cache).fingerprint == built.fingerprint
        assert kept.name in caplog.text


def test_a_changed_file_is_another_scene(tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    write_cube(tmp_path / "cube.ply")
    before = load_scene("cube.ply", relative_to=tmp_path, cache=cache)
    write_cube(tmp_path / "cube.ply", (10, 200, 40, 255))
    assert load_scene("cube.ply", relative_to=tmp_path, cache=cache).fingerprint != before.fingerprint


def test_texture_contrast_flattens_towards_the_mean_colour() -> None:
    image = np.random.default_rng(0).integers(40, 200, (64, 64, 3)).astype(np.uint8)
    assert with_contrast(image, 1.0) is image
    quarter = with_contrast(image, 0.25)
    assert quarter.std(axis=(0, 1)) == pytest.approx(0.25 * image.std(axis=(0, 1)), rel=0.02)
    assert quarter.mean(axis=(0, 1)) == pytest.approx(image.mean(axis=(0, 1)), abs=0.5)
    assert (np.ptp(with_contrast(image, 0.0), axis=(0, 1)) == 0).all()


def test_texture_contrast_makes_another_scene_of_the_same_shape_that_is_cached_beside_the_first(tmp_path: Path) -> None:
    checks = (np.indices((8, 8)).sum(axis=0) % 2 * 200).astype(np.uint8)
    Image.fromarray(checks[..., None].repeat(3, axis=2)).save(tmp_path / "paint.png")
    (tmp_path / "tile.mtl").write_text("newmtl paint\nmap_Kd paint.png\n")
    corners = "v -2 -2 0\nv 2 -2 0\nv 2 2 0\nv -2 2 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    (tmp_path / "tile.obj").write_text(f"mtllib tile.mtl\n{corners}usemtl paint\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n")
    cache = tmp_path / "cache"
    scenes = [
        load_scene("tile.obj", relative_to=tmp_path, cache=cache, texture_contrast=contrast)
        for contrast in (1.0, 0.5, 0.0, 0.5)
    ]
    assert len({scene.fingerprint for scene in scenes}) == len(list(cache.iterdir())) == 3
    assert scenes[1].fingerprint == scenes[3].fingerprint
    assert all(np.array_equal(scene.light, scenes[0].light) for scene in scenes)
    assert [int(np.ptp(scene.textures.texels[:64] & 255)) for scene in scenes] == [200, 100, 0, 100]


def test_building_twice_gives_the_same_bytes() -> None:
    assert build_scene(stage(), WHITE).fingerprint == build_scene(stage(), WHITE).fingerprint


def test_baked_light_is_darker_beside_a_box_and_brighter_on_top_than_on_its_sides() -> None:
    lit = bake(stage())
    brightness = lit.colour.mean(axis=-1)
    x, y, z = np.moveaxis(lit.triangles, -1, 0)
    on_floor, apart = z < 1e-6, np.hypot(x, y)
    beside = brightness[on_floor & (apart > 0.55) & (apart < 0.65) & (x < 0)].mean()
    open_floor = brightness[on_floor & (apart > 1.8)].mean()
    assert beside < 0.9 * open_floor
    facing_up = np.ptp(lit.triangles[..., 2], axis=1) < 1e-6
    top = brightness[facing_up & (z.min(axis=1) > 0.7)].mean()
    assert brightness[~facing_up].mean() < 0.9 * top
    assert open_floor == pytest.approx(top, rel=0.05)


def test_splitting_for_light_keeps_the_surface_and_its_texture_coordinates() -> None:
    before = stage()
    after = bake(before)
    assert len(after.triangles) > 4 * len(before.triangles)
    assert area(after) == pytest.approx(area(before))
    on_floor = (after.triangles[..., 2] == 0).all(axis=1)
    x, y = after.triangles[on_floor, :, 0], after.triangles[on_floor, :, 1]
    assert np.allclose(after.uv[on_floor], np.stack([x + 2, 2 - y], axis=-1))
    assert len(after.triangles) < 1500  # 16 m2 split everywhere would be over 3000


def test_solids_face_outwards_and_have_their_volume() -> None:
    assert volume(box((1.0, 2.0, 0.5), Material(0), (3.0, 1.0, 0.2))) == pytest.approx(1.0)
    assert volume(cushion((1.0, 1.0, 0.4), 0.01, Material(0))) == pytest.approx(0.4, rel=0.02)
    assert volume(cushion((0.4, 0.4, 0.4), 0.2, Material(0))) == pytest.approx(4 / 3 * math.pi * 0.008, rel=0.1)
    assert volume(rod((1.0, 0, 0), (1.0, 3.0, 0), 0.1, Material(0), 64)) == pytest.approx(0.03 * math.pi, rel=0.01)
    cylinder = lathe([(0.0, 0.0), (0.5, 0.0), (0.5, 1.0), (0.0, 1.0)], Material(0), 64)
    assert volume(cylinder) == pytest.approx(0.25 * math.pi, rel=0.01)


def test_turning_and_shifting_keep_shape_and_winding() -> None:
    turned = box((1.0, 2.0, 0.5), Material(0)).tilted(30).moved(1, 2, 3, yaw_deg=40)
    assert volume(turned) == pytest.approx(1.0)


def test_mip_levels_average_and_odd_sizes_become_powers_of_two() -> None:
    checks = (np.indices((8, 16)).sum(axis=0) % 2 * 200).astype(np.uint8)
    textures = build_texture_set([checks[..., None].repeat(3, axis=2), np.full((5, 7, 3), (9, 80, 200), np.uint8)])
    assert textures.sizes.tolist() == [[16, 8, 5], [8, 8, 4]]
    last = textures.texels[textures.offsets[np.arange(2), textures.sizes[:, 2] - 1]]
    assert [int(last[0] & 255), int(last[1] & 255), int(last[1] >> 8 & 255), int(last[1] >> 16)] == [100, 9, 80, 200]


def test_the_living_room_fills_the_box_and_its_tall_furniture_stands_at_the_edge() -> None:
    surfaces, images = living_room()
    assert np.isfinite(surfaces.triangles).all()
    assert np.isfinite(surfaces.uv).all()
    assert set(surfaces.texture.tolist()) == set(range(len(images)))
    inside = (np.abs(surfaces.triangles[..., :2]) < 3.3).all(axis=(1, 2))
    furniture = surfaces.triangles[inside]
    assert furniture[..., 2].max() <= 2.0
    assert furniture[..., :2].min() < -2.5
    assert furniture[..., :2].max() > 2.5
    tall = furniture[furniture[..., 2].max(axis=1) > 1.2]
    assert (np.abs(tall[..., :2]).max(axis=-1) > 2.0).all()
    assert all(image.std() > 12 for image in images)
