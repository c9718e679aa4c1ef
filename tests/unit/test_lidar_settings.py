"""What missions with a lidar must be, and what they may not."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from protocol.mission import Mission


def mission(**settings: Any) -> Mission:
    plain = {"localization": {"source": "lidar"}, "drones": [{"id": 1, "start": (0, 1, 2, 0, 1.3)}]}
    return Mission.model_validate(plain | settings)


def test_scans_fall_on_ticks() -> None:
    assert mission().scan_ticks == 2
    assert mission(lidar={"rate_hz": 20.0}).scan_ticks == 1
    assert mission(lidar={"rate_hz": 7.0}).scan_ticks == 3


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"lidar": {"rate_hz": 25.0}}, r"lidar\.rate_hz: must be at most controller\.rate_hz, 20"),
        ({"simulation": {"scene": ""}}, "needs a scene"),
        ({"vehicles": {"kind": "px4"}}, "simulated lidars alone"),
        ({"lidar": {"elevation_rad": (-1.5, -0.5)}}, "must reach the horizon"),
        ({"lidar": {"elevation_rad": (0.2, 0.1)}}, "must ascend"),
        ({"lidar": {"range_min_m": 21.0}}, "range_min_m must be less"),
    ],
)
def test_a_lidar_that_cannot_do_its_work_is_refused_before_the_flight(settings: dict[str, Any], said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        mission(**settings)


def test_without_a_lidar_its_settings_are_nobodys_concern() -> None:
    assert mission(localization={}, vehicles={"kind": "px4"}).localization.source == "vehicle"
