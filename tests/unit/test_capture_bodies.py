"""What is made of a motion capture system's frames: whose poses, how often, and which are no measurements."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ground_station.motion_capture.bodies import FROZEN_S, MISSING_S, Bodies, Seen
from protocol.localization_settings import Mocap
from protocol.messages import ExternalPose
from protocol.mission import Drone, Mission

LEVEL = (1.0, 0.0, 0.0, 0.0)
FRAMES_HZ = 100.0


def mission(**capture: object) -> Mission:
    drones = Drone(id=2, start=(0, 1, 2, 0, 1.3)), Drone(id=5, start=(0, -1, 2, 0, 1.3), body="blue")
    return Mission(mocap=Mocap.model_validate(capture), drones=drones)


class Watched:
    def __init__(self, **capture: object) -> None:
        self.said: list[str] = []
        self.bodies = Bodies(mission(**capture), self.said.append, 0.0)
        self.now_s = 0.0
        self._dice = np.random.default_rng(0)

    def jitter(self, x: float) -> Seen:
        """As a body that stands still is measured."""
        return (x + float(self._dice.normal(0, 1e-4)), 0.0, 1.0), LEVEL

    def frame(self, **seen: Seen) -> list[ExternalPose]:
        self.now_s += 1 / FRAMES_HZ
        named = {name.replace("_", "-"): one for name, one in seen.items()}
        return self.bodies.frame(named, self.now_s, 7, 0.01)


def test_each_drone_s_body_is_passed_on_under_its_number() -> None:
    watched = Watched()
    one, other = watched.frame(drone_2=((1.0, 2.0, 3.0), LEVEL), blue=((4.0, 5.0, 6.0), LEVEL))
    assert (one.drone, one.position, one.attitude, one.tick, one.age_s) == (2, (1.0, 2.0, 3.0), LEVEL, 7, 0.01)
    assert (other.drone, other.position) == (5, (4.0, 5.0, 6.0))


def test_poses_are_no_more_often_than_asked_for_and_hardly_less() -> None:
    watched = Watched(rate_hz=50.0)
    passed = [watched.frame(drone_2=watched.jitter(0.0)) for _ in range(200)]
    count = sum(pose.drone == 2 and pose.position is not None for poses in passed for pose in poses)
    assert count == pytest.approx(100, abs=2)
    assert "drone 2: 5" in watched.bodies.report(2.0)


def test_a_body_that_is_not_seen_is_passed_on_as_such_and_told_of_once_and_so_is_its_return() -> None:
    watched = Watched()
    for _ in range(round(2 * MISSING_S * FRAMES_HZ)):
        poses = watched.frame(drone_2=watched.jitter(0.0))
        assert all(pose.position is None for pose in poses if pose.drone == 5)
    watched.frame(blue=watched.jitter(1.0))
    assert watched.said == [
        "drone 2: its body 'drone-2' is seen",
        "drone 5: its body 'blue' is not seen",
        "drone 5: its body 'blue' is seen",
    ]


def test_a_place_that_is_repeated_to_the_last_bit_is_no_measurement() -> None:
    """Nothing must fly by the last pose of a body that was lost."""
    watched = Watched()
    frames = round(2 * FROZEN_S * FRAMES_HZ)
    passed = [watched.frame(drone_2=((1.0, 0.0, 1.0), LEVEL)) for _ in range(frames)]
    believed = [poses[0].position is not None for poses in passed if poses]
    assert believed[0]
    assert not believed[-1]
    assert sum(believed) / len(believed) == pytest.approx(0.5, abs=0.05)
    assert watched.frame(drone_2=watched.jitter(1.0)) or watched.frame(drone_2=watched.jitter(1.0))


def test_the_library_s_own_mock_stands_still_and_may() -> None:
    watched = Watched(system="mock")
    passed = [watched.frame(drone_2=((1.0, 0.0, 1.0), LEVEL)) for _ in range(200)]
    assert all(poses[0].position is not None for poses in passed if poses)


@pytest.mark.parametrize(
    "broken",
    [((math.nan, 0.0, 0.0), LEVEL), ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)), ((0.0, 0.0, 0.0), (2.0, 0, 0, 0))],
)
def test_what_is_no_pose_is_not_seen(broken: Seen) -> None:
    assert Watched().frame(drone_2=broken)[0].position is None


def test_bodies_of_nobody_are_told_of_once() -> None:
    watched = Watched()
    for _ in range(3):
        watched.frame(wand=watched.jitter(0.0), drone_2=watched.jitter(0.0))
    assert [text for text in watched.said if "wand" in text] == [
        "other bodies are seen too: wand; drones' are named by drones.body"
    ]
