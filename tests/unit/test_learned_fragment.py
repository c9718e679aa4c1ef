"""How keyframes become a fragment, where its window lies, and how blocks are averaged into the map: without torch."""

from __future__ import annotations

import numpy as np
import pytest

from ground_station.reconstruction.fusion import WEIGHT_MAX, Volume
from ground_station.reconstruction.learned.fragment import (
    APART_M,
    COARSE,
    FINE_M,
    HALVED,
    REACH_M,
    VIEWS,
    WINDOW,
    choose_views,
    middle_of,
    place_window,
    projection,
)
from ground_station.reconstruction.views import View
from protocol.geometry import Intrinsics, camera_rotation
from protocol.mission import Box, Target

CAMERA = Intrinsics.from_field_of_view(160, 90, 1.287)
BOX = Target()


def view(x: float, y: float = 0.0, z: float = 1.6, yaw: float = 0.0, pitch: float = 1.5) -> View:
    return View(np.empty((0, 0), np.uint8), np.array([x, y, z]), camera_rotation(yaw, pitch), CAMERA)


def test_a_projection_runs_from_0_to_1_across_and_down_the_image() -> None:
    one = view(0.3, 0.2)
    right, down, ahead = one.rotation.T
    corner = one.position + 2 * (ahead + right * 80 / CAMERA.fx + down * 45 / CAMERA.fy)
    assert projection(one) @ [*(one.position + 2 * ahead), 1] == pytest.approx([1.0, 1.0, 2.0])
    assert projection(one) @ [*corner, 1] == pytest.approx([2.0, 2.0, 2.0])


def test_views_of_a_fragment_are_the_newest_that_are_apart() -> None:
    path = [view(0.07 * number) for number in range(20)]
    chosen = choose_views(path[::-1], BOX)
    assert chosen == sorted(chosen)
    assert chosen[0] == 0
    gaps = np.diff([0.07 * number for number in chosen])
    assert gaps == pytest.approx(np.full(len(gaps), 0.21))
    assert gaps.min() >= APART_M


def test_a_view_from_the_same_place_counts_when_it_is_turned() -> None:
    assert choose_views([view(0), view(0.02), view(0.02, yaw=0.3)], BOX) == [0, 2]


def test_views_that_show_another_place_are_left_out() -> None:
    assert choose_views([view(0), view(4.0), view(0.5, pitch=-1.4), view(0.4)], BOX) == [0, 3]


def test_a_fragment_has_at_most_so_many_views() -> None:
    around = [view(0.3 * (number % 5), 0.25 * (number // 5)) for number in range(25)]
    assert len(choose_views(around, BOX)) == VIEWS


@pytest.mark.parametrize("centre", [(0.0, 0.0, 0.5), (-9.0, 9.0, -3.0), (2.9, -2.9, 1.9), (0.333, 0.777, 1.0)])
def test_a_window_lies_within_the_map_and_on_the_coarse_lattice(centre: tuple[float, float, float]) -> None:
    volume = Volume(BOX, FINE_M, REACH_M)
    window = place_window(np.array(centre), volume.origin, volume.distance.shape)
    assert window.coarse == WINDOW
    for first, size, have in zip(window.first, window.fine, volume.distance.shape, strict=True):
        assert first % COARSE == 0
        assert first >= 0
        assert first + size <= have + COARSE * HALVED
    lower = volume.origin + FINE_M * np.array(window.first)
    inside = np.clip(centre, BOX.lower_m, BOX.upper_m)
    assert (lower <= inside).all()
    assert (inside <= lower + FINE_M * np.array(window.fine)).all()


def test_a_window_is_no_larger_than_a_small_map() -> None:
    small = Volume(Box(lower_m=(0, 0, 0), upper_m=(1, 0.3, 0.5)), FINE_M, REACH_M)
    window = place_window(np.array([0.5, 0.1, 0.2]), small.origin, small.distance.shape)
    assert window.first == (0, 0, 0)
    assert window.coarse == (16, 8, 12)
    assert all(size >= have for size, have in zip(window.fine, small.distance.shape, strict=True))


def test_a_fragment_is_where_its_views_look() -> None:
    middle = middle_of([view(x, pitch=np.pi / 2) for x in (0.8, 1.0, 1.2)], BOX)
    assert middle[:2] == pytest.approx([1.0, 0.0])
    assert 0.0 < middle[2] < 0.6


@pytest.fixture
def volume() -> Volume:
    return Volume(Box(lower_m=(0, 0, 0), upper_m=(0.4, 0.4, 0.4)), FINE_M, REACH_M)


def full(value: float, size: int = 4) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    return np.full((size,) * 3, value, np.float32)


def test_blocks_are_averaged_by_weight(volume: Volume) -> None:
    grey, white = np.full((4, 4, 4, 3), 100, np.uint8), np.full((4, 4, 4, 3), 200, np.uint8)
    volume.blend((2, 2, 2), full(0.08), full(1.0), grey)
    volume.blend((2, 2, 2), full(0.04), full(3.0), white)
    assert volume.distance[3, 3, 3] == pytest.approx(0.05)
    assert volume.weight[3, 3, 3] == pytest.approx(4.0)
    assert volume.color[3, 3, 3].tolist() == [175, 175, 175]
    assert np.count_nonzero(volume.weight) == 4**3


def test_what_a_block_does_not_know_stays_as_it_was(volume: Volume) -> None:
    nothing = np.zeros((4, 4, 4, 3), np.uint8)
    volume.blend((0, 0, 0), full(0.08), full(1.0), np.full((4, 4, 4, 3), 50, np.uint8))
    volume.blend((0, 0, 0), full(-0.1), full(0.0), nothing)
    assert volume.distance[1, 1, 1] == pytest.approx(0.08)
    volume.blend((0, 0, 0), full(0.12), full(1.0), nothing)
    assert volume.color[1, 1, 1].tolist() == [50, 50, 50], "black is no colour"


def test_a_block_may_reach_beyond_the_volume_and_weights_are_bounded(volume: Volume) -> None:
    last = tuple(size - 2 for size in volume.distance.shape)
    for _ in range(30):
        volume.blend((last[0], last[1], last[2]), full(0.02), full(1.0), np.zeros((4, 4, 4, 3), np.uint8))
    assert np.count_nonzero(volume.weight) == 2**3
    assert volume.weight.max() == WEIGHT_MAX
