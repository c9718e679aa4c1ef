"""What missions with motion capture must be, and what they may not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from deploy.local import SERVANTS, mission_roles
from protocol.mission import Mission

START = (0, 1, 2, 0, 1.3)
OTHER = (2, 1, 2, 0, 1.3)


def mission(**settings: Any) -> Mission:
    plain = {"localization": {"source": "mocap"}, "drones": [{"id": 1, "start": START}]}
    return Mission.model_validate(plain | settings)


def test_bodies_are_named_after_their_drones_unless_they_are_named() -> None:
    drones = [{"id": 1, "start": START}, {"id": 7, "start": OTHER, "body": "cf7"}]
    assert [drone.rigid_body for drone in mission(drones=drones).drones] == ["drone-1", "cf7"]


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"vehicles": {"kind": "px4", "origin": (47.0, 8.0, 400.0)}}, "origin: must be left out"),
        ({"vehicles": {"kind": "px4", "camera_mount": "gimbal"}}, "motion capture sees the vehicle's yaw"),
        (
            {"drones": [{"id": 1, "start": START, "body": "drone-2"}, {"id": 2, "start": OTHER}]},
            r"drones\.1\.body: 'drone-2' is drone 1's already",
        ),
        ({"mocap": {"system": "sextant"}}, "optitrack"),
        ({"mocap": {"latency_s": 3.0}}, "latency_s"),
    ],
)
def test_what_cannot_work_is_refused_before_the_flight(settings: dict[str, Any], said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        mission(**settings)


def test_without_motion_capture_its_settings_are_nobody_s_concern() -> None:
    assert mission(localization={}, vehicles={"kind": "px4", "origin": (47.0, 8.0, 400.0)})


def test_the_bridge_is_started_with_a_run_that_asks_for_it_and_ends_with_it() -> None:
    roles = {role.kind: role for role in mission_roles(Path("run"), "tcp/127.0.0.1:7", [1], "1", px4=True, mocap=True)}
    assert "ground_station.motion_capture" in roles["mocap"].command
    assert "mocap" in SERVANTS
    assert "mocap" not in {role.kind for role in mission_roles(Path("run"), "tcp/127.0.0.1:7", [1], "1")}
