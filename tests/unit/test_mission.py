"""What the mission model refuses, setting by setting and across settings."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from typing import Any, TypeAlias

import pytest
from pydantic import ValidationError

from protocol.map_settings import Camera, Feedback
from protocol.mission import Box, Mission

Place: TypeAlias = tuple[str | int, ...]

TWO: dict[str, Any] = {
    "drones": [{"id": 1, "start": (0, 1, 2, 0, 1.3)}, {"id": 2, "start": (1.5, 1, 2, 0, 1.3)}],
}


def changed(place: Place, value: object) -> dict[str, Any]:
    """The whole effective mission of two drones with one setting exchanged."""
    settings = copy.deepcopy(Mission.model_validate(TWO).model_dump())
    inner: Any = settings
    for key in place[:-1]:
        if isinstance(inner[key], tuple):
            inner[key] = list(inner[key])
        inner = inner[key]
    inner[place[-1]] = value
    return settings


def numbers(tree: object, here: Place = ()) -> Iterator[Place]:
    if isinstance(tree, float):
        yield here
    inner = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list | tuple) else ()
    for key, value in inner:
        yield from numbers(value, (*here, key))


def faults(settings: object) -> str:
    with pytest.raises(ValidationError) as caught:
        Mission.model_validate(settings)
    return "\n".join(".".join(map(str, fault["loc"])) + ": " + fault["msg"] for fault in caught.value.errors())


@pytest.mark.parametrize(
    "place", list(numbers(Mission.model_validate(TWO).model_dump())), ids=lambda place: ".".join(map(str, place))
)
def test_no_number_may_be_infinite_or_not_a_number(place: Place) -> None:
    for bad in (math.nan, math.inf, -math.inf):
        assert ".".join(map(str, place)) in faults(changed(place, bad))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_box_has_volume_on_every_axis(axis: int) -> None:
    upper = [1.0, 1.0, 1.0]
    upper[axis] = 0.0
    with pytest.raises(ValidationError, match="must exceed lower_m"):
        Box(lower_m=(0, 0, 0), upper_m=(upper[0], upper[1], upper[2]))


def test_a_box_contains_its_faces_and_nothing_beyond() -> None:
    box = Box(lower_m=(0, 0, 0), upper_m=(1, 2, 3))

    assert box.contains((0, 0, 0))
    assert box.contains((1, 2, 3))
    assert not box.contains((1.001, 1, 1))
    assert not box.contains((0.5, 1, -0.001))


@pytest.mark.parametrize("key", ["yaw_rad", "pitch_rad"])
@pytest.mark.parametrize("angles", [(1.0, 1.0), (1.2, 0.2)])
def test_the_target_s_angles_ascend(key: str, angles: tuple[float, float]) -> None:
    assert f"{key} must be [smaller, larger]" in faults(changed(("target", key), angles))


@pytest.mark.parametrize("limits", [(1.2, 1.2), (1.5, 1.0), (-1.6, 1.0), (0.0, 1.6)])
def test_the_gimbal_s_limits_ascend_within_a_quarter_turn(limits: tuple[float, float]) -> None:
    assert "pitch_limits_rad must ascend within" in faults(changed(("flight", "pitch_limits_rad"), limits))


@pytest.mark.parametrize("key", ["acceleration_max_mps2", "angular_acceleration_max_radps2"])
def test_a_vehicle_can_brake_from_full_speed_within_its_own_model(key: str) -> None:
    assert Mission.model_validate(changed(("flight", key), 0.5 / 0.15 + 1e-9))
    assert f"{key} x response_time_s, 0.45, must be at least" in faults(changed(("flight", key), 3.0))
    assert Mission.model_validate(changed(("flight", "response_time_s"), 0.0))


def test_a_jump_takes_effect_before_the_next_mesh_is_compared() -> None:
    assert Feedback(delay_s=2.0, period_s=2.0).delay_s == 2.0
    with pytest.raises(ValidationError, match=r"delay_s 2\.5 must not exceed period_s 2"):
        Feedback(delay_s=2.5, period_s=2.0)


def test_an_angle_between_keyframes_is_at_most_half_a_turn() -> None:
    assert Camera(keyframe_angle_rad=math.pi).keyframe_angle_rad == math.pi
    with pytest.raises(ValidationError, match="keyframe_angle_rad"):
        Camera(keyframe_angle_rad=math.pi + 1e-6)


def test_ids_of_drones_differ() -> None:
    assert "ids must differ, got [1, 1]" in faults(changed(("drones", 1, "id"), 1))


def test_drones_start_apart() -> None:
    assert Mission.model_validate(changed(("drones", 1, "start"), (1.0, 1, 2, 0, 1.3)))
    assert "0.90 m from drone 1, less than flight.separation_m 1" in faults(
        changed(("drones", 1, "start"), (0.9, 1, 2, 0, 1.3))
    )


@pytest.mark.parametrize("start", [(-4.1, 1, 2, 0, 1.3), (0, 4.1, 2, 0, 1.3), (0, 1, 0.4, 0, 1.3)])
def test_drones_start_inside_the_flight_region(start: tuple[float, ...]) -> None:
    assert "lies outside the flight region" in faults(changed(("drones", 0, "start"), start))


@pytest.mark.parametrize("pitch", [1.0, 1.6])
def test_drones_start_with_a_pitch_that_the_gimbal_has(pitch: float) -> None:
    assert f"pitch {pitch:g} lies outside flight.pitch_limits_rad" in faults(
        changed(("drones", 0, "start"), (0, 1, 2, 0, pitch))
    )


def test_the_nearest_depth_lies_before_the_farthest() -> None:
    assert "nearest_m: must be less than farthest_m" in faults(changed(("reconstruction", "nearest_m"), 4.2))


@pytest.mark.parametrize("place", [("camera", "depth"), ("reconstruction", "backend")])
def test_a_real_camera_gives_no_depth(place: Place) -> None:
    settings = changed(place, True if place[0] == "camera" else "depth")
    assert Mission.model_validate(settings).measures_depth
    settings["vehicles"]["kind"] = "px4"
    settings["drones"][1]["camera"] = "/dev/video0"
    assert "drones.1.camera: gives no depth" in faults(settings)


def test_depth_is_measured_at_the_width_of_the_sweep() -> None:
    camera = Mission.model_validate(changed(("reconstruction", "sweep_width_px"), 160)).sweep_intrinsics()
    assert (camera.width, camera.height) == (160, 90)
    assert not Mission.model_validate(TWO).measures_depth


def test_all_faults_of_a_team_are_told_at_once() -> None:
    settings = changed(("drones", 1), {"id": 1, "start": (0, 1.5, 9, 0, 0.3)})

    told = faults(settings)

    assert all(words in told for words in ("ids must differ", "outside the flight region", "pitch 0.3 lies outside"))


def test_a_mission_needs_a_drone() -> None:
    assert "drones: " in faults({"drones": []})


def test_a_tick_is_the_inverse_of_the_rate() -> None:
    assert Mission.model_validate(TWO | {"controller": {"rate_hz": 50}}).tick_s == 0.02
    assert Mission.model_validate(TWO).tick_s == 0.05


def test_settings_never_change_after_loading() -> None:
    mission = Mission.model_validate(TWO)
    with pytest.raises(ValidationError, match="frozen"):
        mission.flight.separation_m = 0.1


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"controller": {"separation_gain_per_s": 11.0}}, "controller.separation_gain_per_s: times the tick is 0.55"),
        ({"flight": {"pitch_limits_rad": (1.28, 1.32)}}, "flight.pitch_limits_rad: 0.04 apart"),
    ],
)
def test_limits_that_one_tick_could_jump_over_are_refused(settings: dict[str, object], said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        Mission.model_validate({"drones": [{"id": 1, "start": (0.0, 0.0, 2.0, 0.0, 1.3)}], **settings})


@pytest.mark.parametrize("planner", ["lawnmower", "persistent", "angle_aware_down", "angle_aware"])
def test_a_baseline_flies_at_a_height_within_the_region(planner: str) -> None:
    settings = changed(("controller", "planner"), planner)
    settings["planners"]["altitude_m"] = 5.5
    assert "planners.altitude_m: 5.5 lies outside the flight region, 0.5 to 5" in faults(settings)
    settings["controller"]["planner"] = "coverage"
    Mission.model_validate(settings)


@pytest.mark.parametrize("planner", ["lawnmower", "persistent", "angle_aware_down"])
def test_a_camera_that_is_to_look_down_must_be_able_to(planner: str) -> None:
    settings = changed(("controller", "planner"), planner)
    settings["flight"]["pitch_limits_rad"] = (1.0, 1.5)
    assert f"controller.planner: '{planner}' looks straight down" in faults(settings)
    settings["flight"]["pitch_limits_rad"] = (1.0, 1.57)
    Mission.model_validate(settings)
    settings["flight"]["pitch_limits_rad"] = (1.0, 1.5)
    settings["controller"]["planner"] = "angle_aware"
    Mission.model_validate(settings)
