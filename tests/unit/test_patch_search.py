"""A patch is found again to a fraction of a pixel, under other light and from another side, or not at all."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from ground_station.reconstruction.patch_search import SIDE, draw_patch, search
from protocol.geometry import Floats

CAMERA = np.array([200.0, 200.0, 79.5, 44.5])
"""Focal lengths and principal point; at inverse depth 1 a shift of 5 mm is a pixel."""
HERE = np.array([80.0, 45.0])
LEVEL = np.eye(3)


@pytest.fixture(scope="module")
def scene() -> NDArray[np.uint8]:
    rough = gaussian_filter(np.random.default_rng(5).normal(size=(90, 160)), 1.5)
    return np.clip(128 + 50 * rough / rough.std(), 0, 255).astype(np.uint8)


def seen_shifted(scene: NDArray[np.uint8], across: float, down: float) -> NDArray[np.uint8]:
    rows, columns = np.mgrid[0:90, 0:160].astype(float)
    moved = map_coordinates(scene.astype(float), [rows - down, columns - across], order=1, mode="nearest")
    return np.rint(moved).astype(np.uint8)


def drawn(scene: NDArray[np.uint8], turn: Floats = LEVEL, shift: Floats | None = None) -> NDArray[np.float32]:
    patch = np.empty((SIDE, SIDE), np.float32)
    assert draw_patch(scene, HERE, CAMERA, 1.0, turn, np.zeros(3) if shift is None else shift, CAMERA, patch)
    return patch


def test_a_shift_is_found_to_a_sixth_of_a_pixel(scene: NDArray[np.uint8]) -> None:
    other = seen_shifted(scene, 3.3, -2.6)
    column, row, like = search(other, drawn(scene), (80.0, 45.0, 80.0, 45.0), 6.0)
    assert (column, row) == pytest.approx((83.3, 42.4), abs=0.16)
    assert like > 0.9


def test_other_light_does_not_matter(scene: NDArray[np.uint8]) -> None:
    darker = (seen_shifted(scene, 2.0, 1.0) * 0.5 + 60).astype(np.uint8)
    column, row, _ = search(darker, drawn(scene), (80.0, 45.0, 80.0, 45.0), 4.0)
    assert (column, row) == pytest.approx((82.0, 46.0), abs=0.1)


def test_the_patch_is_turned_as_the_other_camera_is(scene: NDArray[np.uint8]) -> None:
    angle = 0.4
    roll = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    rows, columns = np.mgrid[0:90, 0:160].astype(float)
    x, y = columns - CAMERA[2], rows - CAMERA[3]
    source = [-np.sin(angle) * x + np.cos(angle) * y + CAMERA[3], np.cos(angle) * x + np.sin(angle) * y + CAMERA[2]]
    other = np.rint(map_coordinates(scene.astype(float), source, order=1, mode="nearest")).astype(np.uint8)
    expected = roll[:2, :2] @ (HERE - CAMERA[2:]) + CAMERA[2:]
    place = (*expected, *expected)
    column, row, like = search(other, drawn(scene, roll), place, 3.0)
    assert (column, row) == pytest.approx(tuple(expected), abs=0.2)
    assert like > 0.9
    assert search(other, drawn(scene), place, 3.0)[2] < like, "unturned it looks less alike"


def test_along_a_line_a_place_far_off_is_found_and_beside_it_none(scene: NDArray[np.uint8]) -> None:
    other = seen_shifted(scene, 20.0, 10.0)
    assert search(other, drawn(scene), (90.0, 50.0, 110.0, 60.0), 1.5)[:2] == pytest.approx((100.0, 55.0), abs=0.1)
    assert search(other, drawn(scene), (90.0, 60.0, 110.0, 70.0), 1.5)[2] == 0.0


def test_a_pattern_that_repeats_is_not_taken(scene: NDArray[np.uint8]) -> None:
    tile = np.tile(scene[40:52, 70:82], (8, 14))[:90, :160]
    assert search(tile, drawn(tile), (80.0, 45.0, 80.0, 45.0), 3.0)[2] > 0.9
    assert search(tile, drawn(tile), (80.0, 45.0, 80.0, 45.0), 14.0)[2] == 0.0


def test_nothing_is_found_outside_the_image_and_nothing_drawn_of_bare_walls(scene: NDArray[np.uint8]) -> None:
    assert search(scene, drawn(scene), (-30.0, 10.0, -20.0, 12.0), 3.0)[2] == 0.0
    patch = np.empty((SIDE, SIDE), np.float32)
    bare = np.full_like(scene, 99)
    assert not draw_patch(bare, HERE, CAMERA, 1.0, LEVEL, np.zeros(3), CAMERA, patch)
    assert not draw_patch(scene, HERE, CAMERA, 1.0, LEVEL, np.array([0.0, 0.0, -0.7]), CAMERA, patch), "too large"
    assert not draw_patch(scene, HERE, CAMERA, 1.0, LEVEL, np.array([0.0, 0.0, -2.0]), CAMERA, patch), "behind it"
