"""Depth of a slanted, textured plane whose true depth is known in every pixel."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec

import numpy as np
import pytest

from faults.plain_sweep import plain_costs
from ground_station.reconstruction import depth_map
from ground_station.reconstruction.consistency import agreements
from ground_station.reconstruction.depth_map import DepthEstimator, Estimator, make_estimator, planes
from ground_station.reconstruction.depth_range import DepthRange, depth_range
from ground_station.reconstruction.plane_sweep import COST_MAX, RADIUS, PlaneSweep, plane_homography
from ground_station.reconstruction.views import View
from protocol.errors import ReconstructionError
from protocol.geometry import Floats, Intrinsics, camera_rotation
from protocol.map_settings import Reconstruction
from protocol.mission import Box

CAMERA = Intrinsics.from_field_of_view(128, 72, 1.287)
SPAN = DepthRange(nearest=0.6, farthest=2.4, typical=1.5)


def floor_texture(x: Floats, y: Floats) -> Floats:
    """Sum of waves from 6 to 60 cm long: never the same twice within the view."""
    rng = np.random.default_rng(3)
    total = np.zeros_like(x)
    for _ in range(24):
        direction, phase = rng.uniform(0, 2 * np.pi, 2)
        length = 0.06 * 10 ** rng.uniform(0, 1)
        total += np.sin(2 * np.pi / length * (x * np.cos(direction) + y * np.sin(direction)) + phase)
    return total


def floor_depth(position: Floats, rotation: Floats) -> tuple[Floats, Floats]:
    """Depth along the optical axis (H, W) and world points (H, W, 3) of the plane z = 0."""
    columns, rows = np.meshgrid(np.arange(CAMERA.width) + 0.5, np.arange(CAMERA.height) + 0.5)
    rays = np.stack([(columns - CAMERA.cx) / CAMERA.fx, (rows - CAMERA.cy) / CAMERA.fy, np.ones_like(rows)], axis=-1)
    rays = rays @ rotation.T
    depth = -position[2] / rays[..., 2]
    return depth, position + depth[..., None] * rays


def view_from(x: float, y: float, z: float, yaw: float, pitch: float) -> View:
    position, rotation = np.array([x, y, z]), camera_rotation(yaw, pitch)
    _, points = floor_depth(position, rotation)
    grey = np.clip(128 + 14 * floor_texture(points[..., 0], points[..., 1]), 0, 255).astype(np.uint8)
    return View(grey, position, rotation, CAMERA)


@pytest.fixture(scope="module")
def views() -> list[View]:
    return [
        view_from(0.0, 0.0, 1.5, 0.3, 1.3),
        view_from(0.18, 0.0, 1.5, 0.4, 1.35),
        view_from(-0.15, 0.05, 1.6, 0.1, 1.25),
        view_from(0.0, 0.2, 1.45, 0.3, 1.3),
        view_from(0.05, -0.17, 1.5, 0.9, 1.4),
    ]


@pytest.fixture(scope="module")
def estimator() -> DepthEstimator:
    return DepthEstimator(CAMERA.width, CAMERA.height, Reconstruction())


def test_the_depth_of_a_plane_is_right_within_a_percent(views: list[View], estimator: DepthEstimator) -> None:
    found = estimator.estimate(views[0], views[1:], SPAN)
    truth, _ = floor_depth(views[0].position, views[0].rotation)
    known = found.depth > 0
    inner = known[2 * RADIUS : -2 * RADIUS, 2 * RADIUS : -2 * RADIUS]
    assert inner.mean() > 0.97
    error = np.abs(found.depth - truth)[known] / truth[known]
    assert np.median(error) < 0.004
    assert np.quantile(error, 0.9) < 0.01


def test_two_depth_maps_of_a_plane_confirm_each_other(views: list[View], estimator: DepthEstimator) -> None:
    first = estimator.estimate(views[0], views[1:], SPAN)
    second = estimator.estimate(views[1], [views[0], *views[2:]], SPAN)
    count = agreements(views[0], first.depth, [(views[1], second.depth)])
    assert count[20:50, 30:90].mean() > 0.95
    wrong = agreements(views[0], first.depth * np.float32(1.1), [(views[1], second.depth)])
    assert wrong.mean() < 0.05


def test_depths_guessed_because_the_true_one_is_beyond_the_planes_are_not_confirmed(
    views: list[View], estimator: DepthEstimator
) -> None:
    near = DepthRange(nearest=0.4, farthest=1.0, typical=0.8)
    first = estimator.estimate(views[0], views[1:], near)
    second = estimator.estimate(views[1], [views[0], *views[2:]], near)
    assert np.mean(agreements(views[0], first.depth, [(views[1], second.depth)])) < 0.15


def test_no_depth_is_believed_where_the_image_shows_nothing(estimator: DepthEstimator) -> None:
    rng = np.random.default_rng(0)
    blank = [
        View(
            rng.integers(126, 130, (CAMERA.height, CAMERA.width)).astype(np.uint8),
            np.array([0.15 * number, 0.0, 1.5]),
            camera_rotation(0.0, np.pi / 2),
            CAMERA,
        )
        for number in range(3)
    ]
    found = estimator.estimate(blank[0], blank[1:], SPAN)
    assert np.mean(found.depth > 0) < 0.2


def test_a_single_source_that_sees_nothing_of_the_view_leaves_every_cost_at_its_worst(views: list[View]) -> None:
    away = View(views[1].grey, np.array([0.0, 0.0, 1.5]), camera_rotation(0.0, -np.pi / 2), CAMERA)
    sweep = PlaneSweep(CAMERA.width, CAMERA.height, 4, 8)
    costs = sweep.costs(views[0], [away], np.linspace(0.5, 2.0, 8, dtype=np.float32))
    assert (costs == COST_MAX).all()


def test_the_homography_maps_a_pixel_to_where_its_point_is_seen(views: list[View]) -> None:
    reference, source = views[0], views[2]
    turn, shift = plane_homography(reference, source)
    depth, points = floor_depth(reference.position, reference.rotation)
    row, column = 20, 90
    projected = turn @ [column, row, 1.0] + shift / depth[row, column]
    expected = source.calibration @ source.rotation.T @ (points[row, column] - source.position)
    np.testing.assert_allclose(projected[:2] / projected[2], expected[:2] / expected[2], atol=1e-9)


def test_the_depth_range_spans_the_box_and_nothing_else() -> None:
    box = Box(lower_m=(-3, -3, 0), upper_m=(3, 3, 1))
    down = View(np.zeros((72, 128), np.uint8), np.array([0.0, 0.0, 2.0]), camera_rotation(0.0, np.pi / 2), CAMERA)
    span = depth_range(down, box, margin_m=0.05)
    assert span is not None
    assert span.nearest == pytest.approx(0.95)
    assert span.farthest == pytest.approx(2.05)
    up = View(down.grey, down.position, camera_rotation(0.0, -np.pi / 2), CAMERA)
    assert depth_range(up, box, margin_m=0.05) is None


@pytest.mark.parametrize("count", [16, 48, 256])
def test_the_farthest_depth_has_a_plane_beyond_it_and_all_are_evenly_spaced(count: int) -> None:
    inverse = planes(0.35, 2.05, count)
    steps = np.diff(inverse)

    assert inverse.shape == (count,)
    assert min(inverse[0], planes(0.35, 4.2, 8)[0]) > 0
    assert inverse[1] <= 1 / 2.05 + 1e-5
    assert inverse[-1] == pytest.approx(1 / 0.35)
    np.testing.assert_allclose(steps, steps[0], rtol=1e-3)


def test_the_costs_are_those_of_the_plain_form(views: list[View]) -> None:
    inverse_depths = np.linspace(0.5, 1.2, 12, dtype=np.float32)
    for sources in (views[1:2], views[1:3], views[1:]):
        costs = PlaneSweep(CAMERA.width, CAMERA.height, 4, 12).costs(views[0], sources, inverse_depths)
        difference = np.abs(costs.astype(int) - plain_costs(views[0], sources, inverse_depths))
        assert costs.min() < 30
        assert np.mean(difference <= 1) > 0.999, "the rest sees the image's edge by rounding"


needs_torch = pytest.mark.skipif(find_spec("torch") is None, reason="torch is not installed (extra learned)")


def on_torch(device: str) -> Estimator:
    estimator: Estimator = import_module("ground_station.reconstruction.torch_sweep").TorchDepthEstimator(
        Reconstruction(), device
    )
    return estimator


def has_card() -> bool:
    return bool(import_module("torch").cuda.is_available())


def assert_the_same_depth(found: depth_map.DepthMap, expected: depth_map.DepthMap) -> None:
    known, expected_known = found.depth > 0, expected.depth > 0
    assert expected_known.mean() > 0.8
    assert np.mean(known == expected_known) > 0.995
    both = known & expected_known
    apart = np.abs(found.depth - expected.depth)[both] / expected.depth[both]
    assert np.quantile(apart, 0.99) < 1e-3
    assert np.quantile(np.abs(found.score - expected.score)[both], 0.99) < 0.01
    assert (found.depth.dtype, found.score.dtype) == (np.float32, np.float32)


@needs_torch
@pytest.mark.parametrize("count", [1, 2, 4])
def test_torch_finds_the_same_depth(views: list[View], estimator: DepthEstimator, count: int) -> None:
    sources = views[1 : 1 + count]
    assert_the_same_depth(
        on_torch("cpu").estimate(views[0], sources, SPAN), estimator.estimate(views[0], sources, SPAN)
    )


@needs_torch
def test_a_graphics_card_finds_the_same_depth(views: list[View], estimator: DepthEstimator) -> None:
    if not has_card():
        pytest.skip("there is no graphics card that torch can use")
    found = on_torch("cuda").estimate(views[0], views[1:], SPAN)
    assert_the_same_depth(found, estimator.estimate(views[0], views[1:], SPAN))


@needs_torch
def test_without_a_card_a_mission_that_asks_for_one_is_refused_and_auto_does_without() -> None:
    if has_card():
        pytest.skip("there is a graphics card")
    with pytest.raises(ReconstructionError, match="sees no graphics card"):
        make_estimator(128, 72, Reconstruction(device="cuda"))
    assert isinstance(make_estimator(128, 72, Reconstruction(device="auto")), DepthEstimator)


def test_without_torch_a_card_is_refused_and_auto_does_without(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(depth_map, "find_spec", lambda _name: None)
    with pytest.raises(ReconstructionError, match="needs torch"):
        make_estimator(128, 72, Reconstruction(device="cuda"))
    for device in ("cpu", "auto"):
        assert isinstance(make_estimator(128, 72, Reconstruction.model_validate({"device": device})), DepthEstimator)
