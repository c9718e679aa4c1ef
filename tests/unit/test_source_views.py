from __future__ import annotations

import numpy as np

from ground_station.reconstruction.source_views import ViewIndex
from ground_station.reconstruction.views import View
from protocol.geometry import Intrinsics, camera_rotation

CAMERA = Intrinsics.from_field_of_view(128, 72, 1.287)
DEPTH = 1.0
BEST = DEPTH * np.tan(np.radians(7.5))
"""Baseline with the best angle."""


def down_from(x: float, y: float, z: float = 1.0, yaw: float = 0.0, pitch: float = np.pi / 2) -> View:
    return View(np.zeros((72, 128), np.uint8), np.array([x, y, z]), camera_rotation(yaw, pitch), CAMERA)


def chosen(views: list[View], count: int, capacity: int = 64) -> list[int]:
    index = ViewIndex(capacity)
    for view in views:
        index.add(view)
    return [int(slot) for slot in index.sources(views[0], DEPTH, count)]


def test_a_view_is_never_its_own_source() -> None:
    assert chosen([down_from(0, 0)], 4) == []
    assert chosen([down_from(0, 0), down_from(0, 0)], 4) == []


def test_the_view_at_the_best_angle_comes_first() -> None:
    views = [down_from(0, 0), down_from(0.2 * BEST, 0), down_from(2.5 * BEST, 0), down_from(1.1 * BEST, 0)]
    assert chosen(views, 1) == [3]


def test_views_are_taken_from_all_sides_before_a_second_from_the_same() -> None:
    views = [down_from(0, 0), down_from(BEST, 0), down_from(0.95 * BEST, 0), down_from(-1.3 * BEST, 0)]
    assert chosen(views, 2) == [1, 3]


def test_views_that_look_elsewhere_are_left_out() -> None:
    turned = down_from(BEST, 0, pitch=0.0)
    beyond = down_from(1.5, 0)
    assert chosen([down_from(0, 0), turned, beyond], 4) == []


def test_views_from_much_further_away_are_left_out() -> None:
    assert chosen([down_from(0, 0), down_from(BEST, 0, z=2.2)], 4) == []


def test_a_view_turned_about_its_axis_is_as_good_as_another() -> None:
    assert chosen([down_from(0, 0), down_from(BEST, 0, yaw=np.pi)], 4) == [1]


def test_a_full_index_forgets_the_oldest_view_first() -> None:
    index = ViewIndex(2)
    slots = [index.add(down_from(x, 0)) for x in (BEST, 5.0, 6.0)]
    assert slots == [0, 1, 0]
    assert len(index) == 2
    assert index.sources(down_from(0, 0), DEPTH, 4).size == 0
