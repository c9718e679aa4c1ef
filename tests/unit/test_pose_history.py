"""An image is posed where the camera was at its moment, and not at all where that is not known."""

from __future__ import annotations

import math
import threading
import time

import numpy as np
import pytest

from agents.cameras.pose_history import BEYOND_MAX_S, GAP_MAX_S, KEPT_S, PoseHistory
from protocol.geometry import Floats, camera_rotation

TICK_S = 0.05
BIT = 1e-6
PATIENCE_S = 20.0


def pose(*, x: float = 0.0, yaw: float = 0.3, pitch: float = 1.2) -> Floats:
    return np.array([x, -1.0, 2.0, yaw, pitch])


def history(*poses: Floats, gap_s: float = TICK_S) -> PoseHistory:
    """Poses from time 10 and tick 200 on."""
    new = PoseHistory()
    for k, each in enumerate(poses):
        new.note(10.0 + k * gap_s, 200 + k, each)
    return new


def about_z(degrees: float) -> Floats:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def test_between_two_poses_an_image_lies_on_the_way() -> None:
    moment = history(pose(x=1.0, yaw=0.2, pitch=1.1), pose(x=2.0, yaw=0.6, pitch=1.3)).at(10.0 + 0.25 * TICK_S)

    assert moment is not None
    assert moment.pose == pytest.approx([1.25, -1.0, 2.0, 0.3, 1.15])
    assert moment.rotation == pytest.approx(camera_rotation(0.3, 1.15))
    assert moment.tick == 200


@pytest.mark.parametrize(("first", "second", "middle"), [(3.1, -3.1, math.pi), (-3.0, 3.1, -3.0916), (0.1, -0.1, 0.0)])
def test_yaw_goes_the_short_way_round(first: float, second: float, middle: float) -> None:
    moment = history(pose(yaw=first), pose(yaw=second)).at(10.0 + 0.5 * TICK_S)

    assert moment is not None
    assert abs(math.remainder(moment.pose[3] - middle, math.tau)) < 1e-4
    assert -math.pi <= moment.pose[3] <= math.pi


def test_a_yaw_that_was_never_wrapped_is_wrapped() -> None:
    moment = history(pose(yaw=7.0), pose(yaw=7.2)).at(10.0 + 0.5 * TICK_S)

    assert moment is not None
    assert moment.pose[3] == pytest.approx(7.1 - math.tau)


def test_rotations_that_are_known_are_turned_by_the_share_and_stay_rotations() -> None:
    poses = PoseHistory()
    level = camera_rotation(0.3, 1.2)
    poses.note(10.0, 200, pose(), level)
    poses.note(10.0 + TICK_S, 201, pose(), about_z(40) @ level)

    moment = poses.at(10.0 + 0.25 * TICK_S)

    assert moment is not None
    assert moment.rotation == pytest.approx(about_z(10) @ level)
    assert moment.rotation @ moment.rotation.T == pytest.approx(np.eye(3))


@pytest.mark.parametrize("known", [0, 1])
def test_where_one_rotation_is_missing_that_of_its_pose_stands_in(known: int) -> None:
    poses = PoseHistory()
    for k in range(2):
        poses.note(10.0 + k * TICK_S, 200 + k, pose(), about_z(20) @ camera_rotation(0.3, 1.2) if k == known else None)

    moment = poses.at(10.0 + 0.5 * TICK_S)

    assert moment is not None
    assert moment.rotation == pytest.approx(about_z(10) @ camera_rotation(0.3, 1.2))


def test_the_tick_of_an_image_is_the_one_that_had_begun() -> None:
    poses = history(*(pose(x=float(k)) for k in range(4)))

    ticks = [moment.tick for share in (0.0, 0.99, 1.0, 2.5) if (moment := poses.at(10.0 + share * TICK_S))]

    assert ticks == [200, 200, 201, 202]


def test_at_a_poses_own_time_it_is_that_pose() -> None:
    poses = history(pose(x=1.0), pose(x=2.0), pose(x=3.0))

    for k in range(3):
        moment = poses.at(10.0 + k * TICK_S)
        assert moment is not None
        assert moment.pose == pytest.approx(pose(x=1.0 + k))


def test_without_poses_nothing_is_posed() -> None:
    assert PoseHistory().at(10.0) is None


@pytest.mark.parametrize("rotation", [None, about_z(33)])
def test_just_outside_of_what_is_known_the_nearest_pose_is_used_and_further_out_none(rotation: Floats | None) -> None:
    poses = PoseHistory()
    for k in range(2):
        poses.note(10.0 + k * TICK_S, 200 + k, pose(x=float(k)), rotation)

    for outside_s, k, sign in ((10.0, 0, -1), (10.0 + TICK_S, 1, 1)):
        moment = poses.at(outside_s + sign * (BEYOND_MAX_S - BIT))
        assert moment is not None
        assert (moment.pose[0], moment.tick) == (k, 200 + k)
        assert moment.rotation == pytest.approx(camera_rotation(0.3, 1.2) if rotation is None else rotation)
        assert poses.at(outside_s + sign * (BEYOND_MAX_S + BIT)) is None


def test_poses_too_far_apart_are_not_interpolated_between() -> None:
    assert history(pose(), pose(), gap_s=GAP_MAX_S - BIT).at(10.1) is not None
    assert history(pose(), pose(), gap_s=GAP_MAX_S + BIT).at(10.1) is None


@pytest.mark.parametrize("stamp_s", [10.0, 9.0])
def test_a_pose_that_is_no_newer_adds_nothing(stamp_s: float) -> None:
    poses = history(pose(x=1.0))
    poses.note(stamp_s, 300, pose(x=5.0))

    moment = poses.at(10.0)
    assert moment is not None
    assert (moment.tick, moment.pose[0]) == (200, 1.0)
    assert poses.at(9.0) is None


def test_poses_are_kept_for_as_long_as_a_link_may_stall_and_no_longer() -> None:
    poses = history(*(pose(x=float(k)) for k in range(1000)))

    newest_s = 10.0 + 999 * TICK_S
    assert poses.at(newest_s - KEPT_S + TICK_S) is not None
    assert poses.at(newest_s - KEPT_S - 2 * BEYOND_MAX_S) is None
    assert len(poses._entries) == round(KEPT_S / TICK_S)


def test_what_is_noted_stays_though_its_arrays_are_used_again() -> None:
    mine, rotation = pose(x=1.0), about_z(5)
    poses = PoseHistory()
    poses.note(10.0, 200, mine, rotation)
    mine[0] = rotation[0, 0] = 9.0

    moment = poses.at(10.0)
    assert moment is not None
    assert moment.pose[0] == 1.0
    assert moment.rotation == pytest.approx(about_z(5))


def test_a_waiting_thread_goes_on_when_a_pose_that_is_new_enough_comes() -> None:
    poses = history(pose())
    came: list[bool] = []
    waiter = threading.Thread(target=lambda: came.append(poses.wait_past(10.2, 1000 * PATIENCE_S)), daemon=True)
    waiter.start()
    deadline_s = time.monotonic() + PATIENCE_S
    while not poses._noted._waiters:  # type: ignore[attr-defined]  # of the standard library's condition
        assert time.monotonic() < deadline_s

    for k in range(1, 5):
        poses.note(10.0 + k * TICK_S, 200 + k, pose())
    waiter.join(PATIENCE_S)

    assert came == [True]
    assert not poses.wait_past(10.2 + BIT, 0.0)
    assert not PoseHistory().wait_past(10.0, 0.0)
