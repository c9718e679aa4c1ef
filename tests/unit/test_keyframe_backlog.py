"""A map that is too slow does without the keyframes that show the least new, and without no others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ground_station.keyframe_backlog import KeyframeBacklog
from protocol.geometry import Intrinsics, camera_rotation
from protocol.keyframe_rule import make_keyframe
from protocol.map_settings import Camera
from protocol.messages import Keyframe

CAMERA = Camera()
LENS = Intrinsics.from_field_of_view(96, 54, 1.287)


def at(x: float, number: int = 0, *, yaw: float = 0.0, drone: int = 1) -> Keyframe:
    rotation = camera_rotation(yaw, 1.3)
    return make_keyframe(drone, number, number, np.array([x, 0.0, 1.5]), rotation, LENS, b"")


def places(keyframes: Sequence[Keyframe]) -> list[float]:
    return [keyframe.position[0] for keyframe in keyframes]


def rest(backlog: KeyframeBacklog) -> tuple[list[Keyframe], list[Keyframe]]:
    """All that is mapped, and all that is passed over."""
    mapped, passed_over = [], []
    while (turn := backlog.take()).keyframes or turn.passed_over:
        mapped += turn.keyframes
        passed_over += turn.passed_over
    return mapped, passed_over


def test_groups_come_out_together_and_in_order_while_there_is_room() -> None:
    backlog = KeyframeBacklog(CAMERA, waiting_max=10)
    groups = [[at(0.0, 1), at(2.0, 1, drone=2)], [at(0.0, 2)], [at(1.0, 3), at(2.0, 3, drone=2)]]
    for group in groups:
        backlog.put(group)
    assert backlog.waiting == 5
    assert [list(backlog.take().keyframes) for _ in groups] == groups
    assert backlog.waiting == backlog.passed_over == 0
    assert backlog.take().keyframes == ()


def test_of_those_that_wait_the_nearest_to_others_is_passed_over() -> None:
    backlog = KeyframeBacklog(CAMERA, waiting_max=4)
    for number, x in enumerate([0.0, 0.5, 0.55, 0.58, 1.5]):
        backlog.put([at(x, number)])
    mapped, passed_over = rest(backlog)
    assert places(mapped) == [0.0, 0.5, 0.58, 1.5]
    assert places(passed_over) == [0.55]
    assert backlog.passed_over == 1


def test_a_place_that_the_map_has_already_is_passed_over_before_a_new_one() -> None:
    backlog = KeyframeBacklog(CAMERA, waiting_max=3)
    backlog.put([at(0.0, 0), at(0.1, 0, drone=2)])
    assert places(backlog.take().keyframes) == [0.0, 0.1]
    for number, x in enumerate([3.0, 0.02, 3.2, 3.4], start=1):
        backlog.put([at(x, number)])
    mapped, passed_over = rest(backlog)
    assert places(mapped) == [3.0, 3.2, 3.4]
    assert places(passed_over) == [0.02]


def test_another_direction_is_something_new() -> None:
    backlog = KeyframeBacklog(CAMERA, waiting_max=5)
    turned = [at(0.0, 0, yaw=0.5 * number, drone=number) for number in (1, 2, 3)]
    backlog.put([*turned, at(2.0, 0, drone=4), at(2.1, 0, drone=5), at(2.2, 0, drone=6)])
    mapped, _ = rest(backlog)
    assert [keyframe.drone for keyframe in mapped] == [1, 2, 3, 4, 6]


def test_a_path_is_thinned_evenly() -> None:
    backlog = KeyframeBacklog(CAMERA, waiting_max=20)
    for number in range(40):
        backlog.put([at(0.12 * number, number)])
    mapped, passed_over = rest(backlog)
    assert (len(mapped), len(passed_over)) == (20, 20)
    assert np.diff(places(mapped)).max() < 3.5 * 0.12, "never a hole"
    assert [one.sequence for one in mapped] == sorted(one.sequence for one in mapped)


def test_what_is_passed_over_comes_out_not_later_than_what_followed_it() -> None:
    backlog = KeyframeBacklog(CAMERA, waiting_max=2)
    for number, x in enumerate([0.0, 0.01, 1.0, 1.01, 2.0]):
        backlog.put([at(x, number)])
    logged: list[int] = []
    while (turn := backlog.take()).keyframes or turn.passed_over:
        logged += [one.sequence for one in (*turn.passed_over, *turn.keyframes)]
    assert logged == [0, 1, 2, 3, 4]


def test_a_map_that_stands_still_costs_no_more_memory_than_there_is_room_for() -> None:
    backlog = KeyframeBacklog(CAMERA, waiting_max=10, held_max=50)
    for number in range(300):
        backlog.put([at(0.05 * number, number)])
    mapped, passed_over = rest(backlog)
    assert (len(mapped), len(passed_over)) == (10, 40)
    assert backlog.lost == 250
