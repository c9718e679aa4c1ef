"""Scores of meshes whose share of right and found surface is known, and Open3D's figures as the reference."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ground_station.evaluation import (
    LIVE_SAMPLES,
    NO_THING,
    Scores,
    Truth,
    floor_baseline,
    load_truth,
    near_surface,
    sample_surface,
    score,
)
from protocol.errors import SceneError
from protocol.mission import Box

BOX = Box(lower_m=(-1.0, -1.0, 0.0), upper_m=(1.0, 1.0, 1.2))
Mesh = tuple[np.ndarray, np.ndarray]
EMPTY: Mesh = (np.empty((0, 3), np.float32), np.empty((0, 3), np.int32))


def patch(origin: tuple[float, ...], along: tuple[float, ...], across: tuple[float, ...], edge: float) -> Mesh:
    """A rectangle in triangles of about ``edge`` metres."""
    u, v = np.array(along), np.array(across)
    columns, rows = (max(1, round(float(np.linalg.norm(side)) / edge)) for side in (u, v))
    s, t = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1), indexing="ij")
    vertices = (np.array(origin) + s[..., None] * u + t[..., None] * v).reshape(-1, 3)
    index = np.arange(len(vertices)).reshape(columns + 1, rows + 1)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    return vertices.astype(np.float32), np.vstack([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)


def joined(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    faces = [faces + start for (_, faces), start in zip(meshes, starts, strict=False)]
    return np.vstack([vertices for vertices, _ in meshes]), np.vstack(faces).astype(np.int32)


def floor(edge: float = 0.03) -> Mesh:
    return patch((-1, -1, 0), (2, 0, 0), (0, 2, 0), edge)


def table(edge: float = 0.03, height: float = 0.6) -> Mesh:
    return joined(
        patch((-0.5, -0.4, height), (1, 0, 0), (0, 0.8, 0), edge),
        patch((-0.5, -0.4, 0), (1, 0, 0), (0, 0, height), edge),
        patch((-0.5, 0.4, 0), (0, 0, height), (1, 0, 0), edge),
    )


def truth_of(mesh: Mesh, count: int = 60_000) -> Truth:
    points = sample_surface(*mesh, count, np.random.default_rng(7)).astype(np.float32)
    everything = np.ones(count, bool)
    return Truth.of(points, everything, everything)


ROOM = joined(floor(), table())
TRUTH = truth_of(ROOM)


def f_scores(scores: Scores) -> list[float]:
    return [scores.visible.f, scores.exposed.f, scores.objects.f]


def shares(scores: Scores) -> list[float]:
    return [
        value for part in (scores.visible, scores.exposed, scores.objects) for value in (part.precision, part.recall)
    ]


def test_a_perfect_map_scores_one() -> None:
    np.testing.assert_allclose(shares(score(*ROOM, TRUTH, BOX)), 1.0)


def test_an_empty_map_scores_zero() -> None:
    assert shares(score(*EMPTY, TRUTH, BOX)) == [0.0] * 6
    assert f_scores(score(*EMPTY, TRUTH, BOX)) == [0.0] * 3


def test_triangles_without_area_score_zero() -> None:
    vertices = np.full((3, 3), 5.0, np.float32)
    assert shares(score(vertices, np.array([[0, 1, 2]], np.int32), TRUTH, BOX)) == [0.0] * 6


def test_a_bare_floor_scores_its_share_of_the_surface_and_nothing_on_objects() -> None:
    baseline = floor_baseline(TRUTH, BOX)
    # Of 4.00 m2 of floor, 0.80 m2 of table top and 1.20 m2 of sides, the floor finds itself and the sides' lowest 5 cm.
    assert baseline.visible.recall == pytest.approx((4.0 + 2 * 0.05) / 6.0, abs=0.005)
    assert baseline.visible.precision == pytest.approx(1.0)
    assert baseline.objects.f == 0.0
    assert f_scores(baseline) == f_scores(score(*floor(2.0), TRUTH, BOX))


def test_a_map_off_by_more_than_the_threshold_is_wrong_and_by_less_is_right() -> None:
    vertices, faces = floor()
    truth = truth_of((vertices, faces))
    for offset_m, expected in ((0.045, 1.0), (0.055, 0.0)):
        moved = (vertices + np.array([0, 0, offset_m], np.float32), faces)
        result = score(*moved, truth, BOX)
        assert result.visible.recall == pytest.approx(expected, abs=1e-9)
        assert result.visible.precision == pytest.approx(expected, abs=0.01)


def test_hidden_points_count_for_nothing() -> None:
    points, faces = ROOM
    samples = sample_surface(points, faces, 30_000, np.random.default_rng(1)).astype(np.float32)
    on_floor = samples[:, 2] < 0.01
    truth = Truth.of(samples, exposed=~on_floor, visible=~on_floor)
    result = score(*floor(), truth, BOX)
    assert result.visible.precision < 0.2  # only near the table's sides
    assert result.exposed.recall < 0.1


def test_visible_and_exposed_recall_are_over_their_own_points() -> None:
    samples = sample_surface(*ROOM, 30_000, np.random.default_rng(1)).astype(np.float32)
    on_floor = samples[:, 2] < 0.01
    truth = Truth.of(samples, exposed=np.ones(30_000, bool), visible=on_floor)
    result = score(*floor(), truth, BOX)
    assert result.visible.recall == 1.0
    assert result.exposed.recall == pytest.approx(4.1 / 6.0, abs=0.01)


def test_what_lies_outside_the_box_is_left_out() -> None:
    half = Box(lower_m=BOX.lower_m, upper_m=(0.0, *BOX.upper_m[1:]))
    vertices, faces = patch((0.2, -1, 0.3), (0.8, 0, 0), (0, 2, 0), 0.05)  # wrong surface, in the other half
    result = score(*joined(ROOM, (vertices, faces)), TRUTH, half)
    np.testing.assert_allclose(shares(result), 1.0)


def test_scores_agree_with_open3d() -> None:
    vertices, faces = ROOM
    noisy = vertices + np.random.default_rng(3).normal(0, 0.03, vertices.shape).astype(np.float32)
    centre = noisy[faces].mean(axis=1)
    kept = faces[np.sin(5 * centre[:, 0]) + np.cos(4 * centre[:, 1]) < 0.8]

    def tensor_mesh(positions: np.ndarray, triangles: np.ndarray) -> o3d.t.geometry.TriangleMesh:
        return o3d.t.geometry.TriangleMesh(o3d.core.Tensor.from_numpy(positions), o3d.core.Tensor.from_numpy(triangles))

    o3d.utility.random.seed(5)  # it draws its points; another draw is another F-score, by some tenths
    metric = [o3d.t.geometry.Metric.FScore]
    for threshold_m in (0.05, 0.1):
        parameters = o3d.t.geometry.MetricParameters(fscore_radius=[threshold_m], n_sampled_points=60_000)
        reference = tensor_mesh(*ROOM).compute_metrics(tensor_mesh(noisy, kept), metric, parameters)
        margin = Box(lower_m=(-2, -2, -1), upper_m=(2, 2, 2))  # compute_metrics does not crop
        result = score(noisy, kept, TRUTH, margin, threshold_m)
        assert 100 * result.visible.f == pytest.approx(float(reference.numpy()[0]), abs=0.3)


@given(st.integers(0, 10_000), st.sampled_from([0.02, 0.05, 0.3]))
@settings(max_examples=25, deadline=None)
def test_nearness_to_the_surface_is_exact(seed: int, threshold_m: float) -> None:
    rng = np.random.default_rng(seed)
    vertices = rng.uniform(-1, 1, (20, 3)).astype(np.float32)
    faces = rng.integers(0, 20, (15, 3)).astype(np.int32)  # some of them without area
    points = rng.uniform(-1.2, 1.2, (300, 3)).astype(np.float32)
    corners = vertices[faces].astype(float)
    weights = rng.dirichlet(np.ones(3), 200)
    on_faces = np.einsum("kc,fcx->fkx", weights, corners).reshape(-1, 3)
    upper_bound = np.linalg.norm(points[:, None] - on_faces, axis=2).min(axis=1)
    near = near_surface(points, vertices, faces, threshold_m)
    assert near[upper_bound <= threshold_m].all()

    proper = faces[np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) > 0]
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor.from_numpy(vertices), o3d.core.Tensor.from_numpy(proper.astype(np.uint32)))
    exact = scene.compute_distance(o3d.core.Tensor.from_numpy(points)).numpy()
    clear = np.abs(exact - threshold_m) > 1e-4
    near = near_surface(points, vertices, proper, threshold_m)
    np.testing.assert_array_equal(near[clear], (exact <= threshold_m)[clear])


def test_the_same_seed_gives_the_same_scores_and_another_seed_nearly() -> None:
    vertices, faces = ROOM
    noisy = vertices + np.random.default_rng(4).normal(0, 0.04, vertices.shape).astype(np.float32)
    first = score(noisy, faces, TRUTH, BOX, seed=1)
    assert first == score(noisy, faces, TRUTH, BOX, seed=1)
    np.testing.assert_allclose(shares(score(noisy, faces, TRUTH, BOX, seed=2)), shares(first), atol=0.002)


def test_the_live_score_is_close_to_the_full_one_and_cheap() -> None:
    vertices, faces = joined(floor(0.01), table(0.01))
    noisy = vertices + np.random.default_rng(5).normal(0, 0.03, vertices.shape).astype(np.float32)
    full = score(noisy, faces, TRUTH, BOX)
    began = time.process_time()
    live = score(noisy, faces, TRUTH, BOX, samples=LIVE_SAMPLES)
    assert time.process_time() - began < 1.0  # measured 0.08 s; the bound only finds a changed order of growth
    np.testing.assert_allclose(f_scores(live), f_scores(full), atol=0.01)


def test_truth_survives_the_file(tmp_path: Path) -> None:
    points = np.random.default_rng(0).random((50, 3)).astype(np.float32)
    exposed = np.arange(50) % 5 > 0
    visible = np.arange(50) % 2 > 0
    np.savez(tmp_path / "truth_samples.npz", points=points, exposed=exposed, visible=visible)
    truth = load_truth(tmp_path)
    assert truth is not None
    np.testing.assert_array_equal(truth.points, points[exposed])
    np.testing.assert_array_equal(truth.visible, visible[exposed])


def test_truth_knows_its_furniture_and_files_of_earlier_versions_have_none(tmp_path: Path) -> None:
    samples = {
        "points": np.random.default_rng(0).random((4, 3)).astype(np.float32),
        "exposed": np.array([True, True, False, True]),
        "visible": np.ones(4, bool),
    }
    np.savez(tmp_path / "truth_samples.npz", **samples)  # type: ignore[arg-type]
    old = load_truth(tmp_path)
    assert old is not None
    assert (old.thing.tolist(), old.names, old.box) == ([NO_THING] * 3, (), None)

    more = {
        "thing": np.array([0, -1, 1, 1], np.int32),
        "names": np.array(["sofa", "lamp"]),
        "box": np.array([[0, 0, 0], [2, 3, 1]]),
    }
    np.savez(tmp_path / "truth_samples.npz", **samples, **more)  # type: ignore[arg-type]
    new = load_truth(tmp_path)
    assert new is not None
    assert (new.thing.tolist(), new.names) == ([0, -1, 1], ("sofa", "lamp"))
    assert new.box == Box(lower_m=(0, 0, 0), upper_m=(2, 3, 1))


def test_a_run_without_truth_has_none(tmp_path: Path) -> None:
    assert load_truth(tmp_path) is None


@pytest.mark.parametrize(
    "arrays",
    [
        {"points": np.zeros((4, 3), np.float32), "exposed": np.ones(4, bool)},
        {"points": np.zeros((4, 2), np.float32), "exposed": np.ones(4, bool), "visible": np.ones(4, bool)},
        {"points": np.zeros((4, 3), np.float32), "exposed": np.ones(4, bool), "visible": np.ones(3, bool)},
        {"points": np.zeros((4, 3), np.float32), "exposed": np.ones(4, int), "visible": np.ones(4, bool)},
        {
            "points": np.zeros((4, 3), np.float32),
            "exposed": np.ones(4, bool),
            "visible": np.ones(4, bool),
            "thing": np.arange(4, dtype=np.int32),
            "names": np.array(["sofa"]),
        },
        {"points": np.full((4, 3), np.nan, np.float32), "exposed": np.ones(4, bool), "visible": np.ones(4, bool)},
    ],
    ids=["missing array", "points not 3-D", "lengths differ", "not bool", "things without names", "not finite"],
)
def test_unusable_truth_is_refused_by_name(tmp_path: Path, arrays: dict[str, np.ndarray]) -> None:
    np.savez(tmp_path / "truth_samples.npz", **arrays)  # type: ignore[arg-type]
    with pytest.raises(SceneError, match=r"truth_samples\.npz"):
        load_truth(tmp_path)


def test_a_damaged_truth_file_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "truth_samples.npz").write_bytes(b"PK\x03\x04 not really")
    with pytest.raises(SceneError, match=r"truth_samples\.npz"):
        load_truth(tmp_path)
