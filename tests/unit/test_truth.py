import logging
import math
from pathlib import Path

import numpy as np
import pytest
import trimesh

from protocol.errors import SceneError
from protocol.map_settings import Camera
from protocol.mission import Drone, Flight, Mission, Target
from sim_bridge.scenes import truth as truth_module
from sim_bridge.scenes.__main__ import main
from sim_bridge.scenes.cropping import crop_to_box
from sim_bridge.scenes.living_room import WALL_M
from sim_bridge.scenes.scene import Scene, pack_scene
from sim_bridge.scenes.surfaces import Material, box, join, quad
from sim_bridge.scenes.things import NO_THING, Thing, thing_at, things_of
from sim_bridge.scenes.truth import SAMPLES_PER_M2, Truth, write_truth
from sim_bridge.scenes.visibility import depression_range

IMAGES = [np.full((4, 4, 3), (90, 160, 40), np.uint8)]
TARGET = Target(lower_m=(-1.0, -1.0, 0.0), upper_m=(1.0, 1.0, 1.5))


def mission(**changes: object) -> Mission:
    drone = Drone(id=1, start=(0.0, 0.0, 3.0, 0.0, math.pi / 2))
    return Mission.model_validate({"target": TARGET, "drones": (drone,), **changes})


def stage(*, canopy: bool = False) -> Scene:
    """A floor of 8 x 8 m with a closed cube of 1 m; the canopy hangs low over the floor's west."""
    grey = Material(0)
    parts = [quad([(-4, -4, 0), (4, -4, 0), (4, 4, 0), (-4, 4, 0)], grey), box((1.0, 1.0, 1.0), grey, (0.4, 0.0, 0.0))]
    if canopy:
        low = [(-3.5, -3.5, 0.2), (-0.3, -3.5, 0.2), (-0.3, 3.5, 0.2), (-3.5, 3.5, 0.2)]
        parts.append(quad(low, Material(0, two_sided=True)))
    return pack_scene(join(parts), IMAGES)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Truth:
    folder = tmp_path_factory.mktemp("truth")
    return write_truth(stage(), mission(), folder, cache=folder / "cache")


def on_cube(truth: Truth) -> np.ndarray:
    return truth.points[:, 2] > 0.01


def test_samples_are_uniform_over_the_surface_inside_the_box(plain: Truth) -> None:
    lower, upper = np.array(TARGET.lower_m), np.array(TARGET.upper_m)
    assert ((plain.points >= lower) & (plain.points <= upper)).all()
    floor_area, cube_area = 4.0 + 1.0, 5.0  # the cube's bottom lies on the floor
    assert len(plain.points) == pytest.approx(SAMPLES_PER_M2 * (floor_area + cube_area), abs=1)
    assert (~on_cube(plain)).sum() == pytest.approx(SAMPLES_PER_M2 * floor_area, rel=0.02)
    x = plain.points[~on_cube(plain)][:, 0]
    assert (x < -0.5).sum() == pytest.approx(SAMPLES_PER_M2, rel=0.04)


def test_the_floor_under_a_closed_box_is_hidden_and_everything_else_is_seen(plain: Truth) -> None:
    x, y = plain.points[:, 0], plain.points[:, 1]
    under = (np.abs(x - 0.4) < 0.48) & (np.abs(y) < 0.48) & ~on_cube(plain)
    assert not plain.exposed[under].any()
    assert not plain.visible[under].any()
    away = (x < -0.15) & ~on_cube(plain)
    assert plain.exposed[away].mean() > 0.999
    assert plain.visible[away].mean() > 0.99
    top = plain.points[:, 2] > 0.99999
    assert plain.visible[top].all()
    sides = on_cube(plain) & ~top & (plain.points[:, 2] > 0.1)
    assert plain.visible[sides].mean() > 0.99


def test_points_belong_to_the_thing_on_whose_surface_they_lie() -> None:
    things = [
        Thing("crate", box((1.0, 1.0, 1.0), Material(0)).triangles),
        Thing("crate 2", box((0.5, 0.5, 0.5), Material(0), (2.0, 0.0, 0.0)).triangles),
    ]
    points = np.array([(0.5, 0.2, 0.3), (2.0, 0.1, 0.5), (1.2, 0.0, 0.0), (0.5, 0.2, 1.01)], np.float32)
    assert thing_at(points, things).tolist() == [0, 1, NO_THING, NO_THING]
    assert thing_at(points, []).tolist() == [NO_THING] * 4


@pytest.mark.parametrize("spec", ["living_room", "room-3"])
def test_built_in_rooms_name_their_furniture_and_all_of_it_stands_in_the_room(spec: str) -> None:
    things = things_of(spec)
    names = [thing.name for thing in things]
    assert len(set(names)) == len(names)
    assert {"sofa", "chair", "chair 2", "dining table", "wardrobe"} <= set(names)
    corners = np.concatenate([thing.triangles.reshape(-1, 3) for thing in things])
    assert np.abs(corners[:, :2]).max() < WALL_M
    assert things_of("./my.glb") == []


def test_what_is_seen_is_exposed(plain: Truth) -> None:
    assert not (plain.visible & ~plain.exposed).any()


def test_floor_deep_under_a_canopy_is_exposed_but_no_steep_view_reaches_it(tmp_path: Path) -> None:
    truth = write_truth(stage(canopy=True), mission(), tmp_path, cache=tmp_path / "cache")
    x, z = truth.points[:, 0], truth.points[:, 2]
    deep = (x < -0.8) & (z < 0.01)  # half a metre in, 0.2 m below: views steeper than 22 degrees are cut off
    assert truth.exposed[deep].mean() > 0.99
    assert not truth.visible[deep].any()
    above = (x < -0.35) & (np.abs(z - 0.2) < 1e-4)
    assert truth.visible[above].all()


def test_sides_are_not_visible_to_a_mission_that_looks_straight_down_with_a_narrow_lens(tmp_path: Path) -> None:
    down = mission(
        camera=Camera(horizontal_fov_rad=0.11),
        flight=Flight(pitch_limits_rad=(math.pi / 2 - 0.01, math.pi / 2), turn_rate_max_radps=0.05),
    )
    truth = write_truth(stage(), down, tmp_path, cache=tmp_path / "cache")
    sides = on_cube(truth) & (truth.points[:, 2] < 0.99999)
    assert truth.exposed[sides].mean() > 0.9
    assert not truth.visible[sides].any()
    assert truth.visible[truth.points[:, 2] > 0.99999].all()


def test_nothing_is_visible_where_no_drone_keeps_its_clearance(tmp_path: Path) -> None:
    # The flight region ends 0.2 m over the floor and the cube fills its middle.
    low = Flight(lower_m=(-1.0, -1.0, 0.0), upper_m=(1.0, 1.0, 0.2))
    drone = Drone(id=1, start=(0.0, 0.0, 0.1, 0.0, math.pi / 2))
    truth = write_truth(stage(), mission(flight=low, drones=(drone,)), tmp_path, cache=tmp_path / "cache")
    assert truth.exposed.any()
    assert not truth.visible.any()


def test_the_steepest_and_flattest_lines_of_sight_follow_from_lens_and_gimbal() -> None:
    narrow = Camera(width_px=128, height_px=128, horizontal_fov_rad=0.2)
    low, high = depression_range(narrow, (0.5, 0.6))
    assert high == pytest.approx(0.6 + 0.1, abs=0.01)
    assert 0.5 - 0.1 - 0.02 < low <= 0.5 - 0.1 + 1e-6  # the image's corners look a little flatter than its top
    assert depression_range(Camera(), (math.pi / 3, math.pi / 2))[1] == pytest.approx(math.pi / 2, abs=1e-6)


def test_the_truth_is_written_as_a_coloured_mesh_cut_at_the_box(tmp_path: Path) -> None:
    truth = write_truth(stage(), mission(), tmp_path, cache=tmp_path / "cache")
    mesh = trimesh.load_mesh(tmp_path / "truth.ply", process=False)
    assert np.allclose(mesh.bounds, [[-1, -1, 0], [1, 1, 1]], atol=1e-6)
    assert mesh.area == pytest.approx(4.0 + 6.0)
    assert (mesh.visual.vertex_colors[:, :3] == (90, 160, 40)).all()
    with np.load(tmp_path / "truth_samples.npz") as data:
        assert data["points"].dtype == np.float32
        for name in ("points", "exposed", "visible"):
            assert np.array_equal(data[name], getattr(truth, name))


def test_samples_are_taken_once_per_scene_and_mission(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache = tmp_path / "cache"
    write_truth(stage(), mission(), tmp_path / "a", cache=cache)
    assert len(list(cache.iterdir())) == 1

    def refuse(*_: object) -> None:
        raise AssertionError("sampled again")

    monkeypatch.setattr(truth_module, "exposed_points", refuse)
    write_truth(stage(), mission(duration_s=9.0), tmp_path / "b", cache=cache)
    samples = [(tmp_path / run / "truth_samples.npz").read_bytes() for run in ("a", "b")]
    assert samples[0] == samples[1]
    with pytest.raises(AssertionError, match="sampled again"):
        write_truth(stage(), mission(flight=Flight(upper_m=(4.0, 4.0, 4.0))), tmp_path / "c", cache=cache)


def test_damaged_samples_are_reported_and_taken_again(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    cache = tmp_path / "cache"
    before = write_truth(stage(), mission(), tmp_path, cache=cache)
    (kept,) = cache.iterdir()
    kept.write_bytes(kept.read_bytes()[:1000])
    with caplog.at_level(logging.WARNING):
        again = write_truth(stage(), mission(), tmp_path, cache=cache)
    assert kept.name in caplog.text
    assert np.array_equal(again.points, before.points)
    assert np.array_equal(again.visible, before.visible)


def test_a_scene_with_nothing_in_the_box_is_refused(tmp_path: Path) -> None:
    far = Target(lower_m=(-1.0, -1.0, 2.0), upper_m=(1.0, 1.0, 3.0))
    with pytest.raises(SceneError, match="no surface inside the target box"):
        write_truth(stage(), mission(target=far), tmp_path, cache=tmp_path / "cache")


def test_cropping_keeps_the_area_inside_the_winding_and_the_place_in_the_source() -> None:
    rng = np.random.default_rng(6)
    triangles = rng.uniform(-2, 2, (300, 3, 3))
    lower, upper = (-1.0, -0.7, -0.5), (0.8, 1.0, 1.2)
    corners, weights, source = crop_to_box(triangles, lower, upper)
    assert (corners >= np.array(lower) - 1e-9).all()
    assert (corners <= np.array(upper) + 1e-9).all()
    assert np.allclose(np.einsum("nij,njk->nik", weights, triangles[source]), corners)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    whole = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    assert (np.einsum("ij,ij->i", normals, whole[source]) > -1e-9).all()
    shares = rng.dirichlet((1, 1, 1), 20_000)
    inside = [
        ((points >= lower) & (points <= upper)).all(axis=1).mean() * np.linalg.norm(normal) / 2
        for points, normal in zip(shares @ triangles, whole, strict=True)
    ]
    assert np.linalg.norm(normals, axis=1).sum() / 2 == pytest.approx(sum(inside), rel=0.01)


def test_the_truth_of_a_scene_that_was_not_flown_is_written_by_a_process_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    trimesh.creation.box((1.0, 1.0, 1.0)).export(tmp_path / "cube.ply")
    (tmp_path / "any.toml").write_text("[[drones]]\nid = 1\nstart = [0.0, 0.0, 3.0, 0.0, 1.3]\n")
    out = tmp_path / "truth"
    assert main([str(tmp_path / "cube.ply"), str(tmp_path / "any.toml"), str(out)]) == 0
    with np.load(out / "truth_samples.npz") as data:
        assert data["box"].tolist() == [[-3.0, -3.0, 0.0], [3.0, 3.0, 2.0]]
        assert data["names"].shape == (0,)
        assert data["visible"].any()
    assert trimesh.load_mesh(out / "truth.ply", process=False).bounds[1].tolist() == [0.5, 0.5, 0.5]

    assert main(["living_rom", str(tmp_path / "any.toml"), str(out)]) == 2
    assert "living_rom: no such scene" in capsys.readouterr().err


def test_what_only_a_no_fly_zone_sees_does_not_count(plain: Truth, tmp_path: Path) -> None:
    west = {"name": "west", "polygon": ((-4.0, -4.0), (0.9, -4.0), (0.9, 4.0), (-4.0, 4.0))}
    flight = Flight(no_fly=(west,))  # type: ignore[arg-type]
    drone = Drone(id=1, start=(2.5, 0.0, 3.0, 0.0, math.pi / 2))
    truth = write_truth(stage(), mission(flight=flight, drones=(drone,)), tmp_path, cache=tmp_path / "cache")

    def seen(told: Truth, x: float) -> float:
        """Of the cube's face at ``x``, without its edges."""
        face = on_cube(told) & (np.abs(told.points[:, 0] - x) < 1e-6) & (np.abs(told.points[:, 2] - 0.55) < 0.4)
        return float(told.visible[face].mean())

    assert seen(plain, -0.1) > 0.9
    assert seen(truth, -0.1) == 0.0
    assert seen(truth, 0.9) > 0.9
    assert truth.exposed.sum() == plain.exposed.sum(), "which is no matter of where one flies"
