"""A simulated camera photographs from where it is, and says where its drone believed it to be."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from protocol.mission import Drone, Mission
from sim_bridge.camera import Camera
from sim_bridge.photographer import Photographer, Sight

MISSION = Mission(drones=(Drone(id=1, start=(0.0, 1.0, 2.0, 0.0, 1.3)),))
TRUTH = np.array([1.0, 2.0, 1.5, 0.3, 1.2])
OFF = np.array([0.2, -0.1, 0.05, 0.02, 0.01])


class NotingCamera:
    def __init__(self) -> None:
        self.seen: list[list[float]] = []

    def render(self, pose: Sequence[float]) -> NDArray[np.uint8]:
        self.seen.append(list(pose))
        return np.zeros((MISSION.camera.height_px, MISSION.camera.width_px, 3), np.uint8)


def sight(shift_m: float = 0.0, *, believed_shift_m: float = 0.0) -> Sight:
    along = np.array([1.0, 0.0, 0.0, 0.0, 0.0])
    return Sight(1, 7, TRUTH + shift_m * along, TRUTH + OFF + believed_shift_m * along, (0.05, 0.01))


def test_the_image_is_the_truth_s_and_the_pose_is_the_believed_one() -> None:
    camera = NotingCamera()
    photographer = Photographer(MISSION, cast("Camera", camera))
    (shot,) = photographer.due_of([sight()])
    keyframe = photographer.take(shot)
    assert camera.seen == [TRUTH.tolist()]
    assert keyframe.position == pytest.approx((TRUTH + OFF)[:3])
    assert (keyframe.tick, keyframe.position_sd_m, keyframe.angle_sd_rad) == (7, 0.05, 0.01)


def test_a_keyframe_is_due_when_the_camera_believes_that_it_has_moved() -> None:
    photographer = Photographer(MISSION, cast("Camera", NotingCamera()))
    far = 2 * MISSION.camera.keyframe_baseline_m
    assert len(photographer.due_of([sight()])) == 1
    assert photographer.due_of([sight(far)]) == []
    assert len(photographer.due_of([sight(far, believed_shift_m=far)])) == 1


def test_of_drones_that_know_where_they_are_both_are_the_same() -> None:
    camera = NotingCamera()
    photographer = Photographer(MISSION, cast("Camera", camera))
    (shot,) = photographer.due(7, {1: TRUTH})
    keyframe = photographer.take(shot)
    assert camera.seen == [TRUTH.tolist()]
    assert keyframe.position == pytest.approx(TRUTH[:3])
    assert keyframe.position_sd_m == 0.0
