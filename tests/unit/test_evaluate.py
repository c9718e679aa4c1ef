"""What ``covrecon evaluate`` says of maps whose faults are known, and Open3D's figures as the reference."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
import trimesh
from PIL import Image

from ground_station.evaluate.__main__ import main
from ground_station.evaluate.errors import coloured, error_mesh, missing_mesh
from ground_station.evaluate.figures import evaluate
from ground_station.evaluate.reference import Reference, open_reference
from ground_station.evaluation import Truth, sample_surface
from protocol.errors import CovreconError
from protocol.mission import Box

BOX = Box(lower_m=(-1.0, -1.0, 0.0), upper_m=(1.0, 1.0, 1.2))
CRATES = {"crate": ((0.5, 0.5, 0.0), 0.4), "crate 2": ((-0.5, -0.4, 0.0), 0.6)}
"""Place of the middle of the bottom, and edge."""
MARGIN = Box(lower_m=(-3.0, -3.0, -1.0), upper_m=(3.0, 3.0, 3.0))
"""So large that nothing is cropped."""
Arrays = tuple[np.ndarray, np.ndarray]


def crate(name: str) -> Arrays:
    (x, y, z), edge = CRATES[name]
    solid = trimesh.creation.box((edge, edge, edge)).subdivide().subdivide().subdivide()
    solid.apply_translation((x, y, z + edge / 2))
    solid.update_faces(solid.triangles_center[:, 2] > 1e-6)
    return solid.vertices.astype(np.float32), solid.faces.astype(np.int32)


def floor() -> Arrays:
    solid = trimesh.Trimesh([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], [(0, 1, 2), (0, 2, 3)])
    for _ in range(5):
        solid = solid.subdivide()
    return solid.vertices.astype(np.float32), solid.faces.astype(np.int32)


def joined(*meshes: Arrays) -> Arrays:
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    faces = [faces + start for (_, faces), start in zip(meshes, starts, strict=False)]
    return np.vstack([vertices for vertices, _ in meshes]), np.vstack(faces).astype(np.int32)


PARTS = [floor(), crate("crate"), crate("crate 2")]
ROOM = joined(*PARTS)


def reference(box: Box = BOX) -> Reference:
    """Each part sampled by itself, so that it is known whose a point is."""
    rng = np.random.default_rng(3)
    drawn = [sample_surface(*part, 20_000, rng).astype(np.float32) for part in PARTS]
    points = np.vstack(drawn)
    thing = np.repeat(np.array([-1, 0, 1], np.int32), 20_000)
    everything = np.ones(len(points), bool)
    truth = Truth.of(points, everything, everything, thing=thing, names=tuple(CRATES))
    return Reference(truth, *ROOM, box, culled=True)


def test_a_perfect_map_is_perfect_in_all_figures() -> None:
    found = evaluate(*ROOM, reference())
    assert [part.f for part in (found.scores.visible, found.scores.exposed, found.scores.objects)] == [1.0, 1.0, 1.0]
    assert found.distances.chamfer_m == pytest.approx(0.0, abs=1e-6)
    assert {thing.name: thing.score.f for thing in found.things} == {"crate": 1.0, "crate 2": 1.0}
    assert found.floor.objects.f == 0.0


def test_a_thing_that_the_map_lacks_has_no_recall_and_one_that_is_moved_no_precision() -> None:
    vertices, faces = crate("crate 2")
    lifted = vertices + np.array([0.0, 0.0, 0.15], np.float32)
    found = {thing.name: thing for thing in evaluate(*joined(floor(), (lifted, faces)), reference()).things}
    assert found["crate"].score.recall == 0.0
    assert found["crate"].score.precision == 0.0  # nothing of the map is near it
    sides = found["crate 2"].score
    assert sides.precision == pytest.approx(4 * (0.6 - 0.1) * 0.6 / (5 * 0.36), abs=0.03)  # of its sides, what overlaps
    assert 0.55 < sides.recall < 0.85
    assert found["crate"].share + found["crate 2"].share == pytest.approx(1.0)


def test_f_score_and_chamfer_distance_agree_with_open3d() -> None:
    vertices, faces = ROOM
    noisy = vertices + np.random.default_rng(3).normal(0, 0.03, vertices.shape).astype(np.float32)
    centre = noisy[faces].mean(axis=1)
    kept = faces[np.sin(5 * centre[:, 0]) + np.cos(4 * centre[:, 1]) < 0.8]

    points = sample_surface(*ROOM, 60_000, np.random.default_rng(7)).astype(np.float32)
    everything = np.ones(len(points), bool)
    evenly = Reference(Truth.of(points, everything, everything), *ROOM, MARGIN, culled=True)
    ours = evaluate(noisy, kept, evenly)

    def tensor_mesh(positions: np.ndarray, triangles: np.ndarray) -> o3d.t.geometry.TriangleMesh:
        return o3d.t.geometry.TriangleMesh(o3d.core.Tensor.from_numpy(positions), o3d.core.Tensor.from_numpy(triangles))

    o3d.utility.random.seed(5)
    metrics = [o3d.t.geometry.Metric.ChamferDistance, o3d.t.geometry.Metric.FScore]
    parameters = o3d.t.geometry.MetricParameters(fscore_radius=[0.05], n_sampled_points=60_000)
    chamfer, f_score = tensor_mesh(*ROOM).compute_metrics(tensor_mesh(noisy, kept), metrics, parameters).numpy()
    assert ours.distances.chamfer_m == pytest.approx(float(chamfer), rel=0.02)
    assert 100 * ours.scores.visible.f == pytest.approx(float(f_score), abs=0.3)


def test_an_empty_map_has_no_distance() -> None:
    found = evaluate(np.empty((0, 3), np.float32), np.empty((0, 3), np.int32), reference())
    assert found.distances.chamfer_m is None
    assert found.scores.visible.f == 0.0
    assert json.loads(json.dumps(found.as_json()))["chamfer_m"] is None


def test_errors_are_blue_where_the_map_is_right_and_red_where_it_is_not() -> None:
    near, far, beyond = coloured(np.array([0.0, 0.1, 9.0], np.float32), 0.05).astype(int)
    assert far.tolist() == beyond.tolist()
    assert far[0] > far[2] + 50
    lifted = joined(floor(), (crate("crate")[0] + np.array([0, 0, 0.5], np.float32), crate("crate")[1]))
    wrong = error_mesh(*lifted, reference(), 0.05)
    on_floor = wrong.vertices[:, 2] == 0
    assert (wrong.colours[on_floor] == near).all()
    assert (wrong.colours[wrong.vertices[:, 2] > 0.6] == far).all()
    missing = missing_mesh(*lifted, reference(), 0.05)
    tops = missing.vertices[:, 2] == np.float32(0.6)  # of the crate that the map lacks
    assert tops.sum() > 50
    assert (missing.colours[tops & (missing.vertices[:, 0] < -0.3)] == far).all()


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """A map as PLY, OBJ and GLB, and the scene's truth as the simulator writes it."""
    solid = trimesh.Trimesh(*ROOM, process=False)
    for name in ("map.ply", "map.obj", "truth.ply"):
        solid.export(tmp_path / name)
    upright = trimesh.Trimesh(np.column_stack([ROOM[0][:, 0], ROOM[0][:, 2], -ROOM[0][:, 1]]), ROOM[1], process=False)
    upright.export(tmp_path / "map.glb")
    truth = reference().truth
    seen = np.ones(len(truth.points), bool)
    box = np.array([BOX.lower_m, BOX.upper_m])
    np.savez(
        tmp_path / "truth_samples.npz",
        points=truth.points, exposed=seen, visible=seen, thing=truth.thing, names=np.array(truth.names), box=box,
    )  # fmt: skip
    return tmp_path


@pytest.mark.parametrize("name", ["map.ply", "map.obj", "map.glb"])
def test_maps_of_any_format_are_evaluated_against_the_simulator_s_truth(
    files: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(files / name), str(files), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["visible"]["f"] > 0.999
    assert {thing["name"] for thing in told["things"]} == set(CRATES)


def test_tables_picture_and_coloured_map_are_written(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture, ply = files / "error.png", files / "error.ply"
    arguments = [files / "map.ply", files / "truth_samples.npz", "--picture", picture, "--ply", ply]
    assert main([str(argument) for argument in arguments]) == 0
    out = capsys.readouterr().out
    assert "crate 2" in out
    assert "F of a bare floor" in out
    assert "Chamfer distance 0.00 cm" in out
    with Image.open(picture) as image:
        assert len(set(image.convert("RGB").reduce(8).get_flattened_data())) > 50
    assert len(trimesh.load_mesh(ply, process=False).vertices) == len(ROOM[0])


def test_a_mesh_taken_for_true_counts_with_all_its_surface(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(files / "map.ply"), str(files / "map.obj")]) == 0
    assert "all of its surface counts" in capsys.readouterr().out
    found = open_reference(files / "map.obj", None)
    assert found.box.lower_m[2] == 0.0  # where the floor is looked for
    assert found.truth.names == ()


@pytest.mark.parametrize(
    ("mesh", "truth", "said"),
    [
        ("none.ply", ".", "no such mesh file"),
        ("truth_samples.npz", ".", "cannot be read as a mesh"),
        ("map.ply", "none.npz", "no truth"),
        ("map.ply", "empty", "no truth"),
        ("empty", ".", "no map"),
    ],
)
def test_what_cannot_be_evaluated_is_told_by_name(
    files: Path, mesh: str, truth: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (files / "empty").mkdir()
    assert main([str(files / mesh), str(files / truth)]) != 0
    assert said in capsys.readouterr().err


def test_a_truth_without_anything_to_see_is_refused(files: Path) -> None:
    nothing = np.zeros(3, bool)
    np.savez(files / "truth_samples.npz", points=np.zeros((3, 3), np.float32), exposed=nothing, visible=nothing)
    with pytest.raises(CovreconError, match="nothing in it can be seen"):
        open_reference(files, None)
