"""The doctor on a drone's own computer, where less is needed than on the ground."""

from __future__ import annotations

from pathlib import Path

import pytest

from deploy.doctor import examination
from deploy.doctor.finding import Finding
from deploy.doctor.ports import Place
from protocol.errors import MissionError
from protocol.mission import Drone, Mission
from protocol.operation_settings import Metrics
from protocol.vehicle_settings import Vehicles

STARTS = ((0.0, 0.0, 2.0, 0.0, 1.5), (2.0, 0.0, 2.0, 0.0, 1.5))
MISSION = Mission(
    metrics=Metrics(port=9100),
    vehicles=Vehicles(kind="px4", url="udpin://127.0.0.1:14540"),
    drones=tuple(Drone(id=number, start=start) for number, start in zip((3, 5), STARTS, strict=True)),
)


@pytest.fixture
def looked_at(monkeypatch: pytest.MonkeyPatch) -> list[Place]:
    """Places that the examination wants to listen at, which it does not."""
    places: list[Place] = []
    monkeypatch.setattr(examination, "check_place", places.append)
    monkeypatch.setattr(examination, "required_libraries", dict)
    return places


def test_only_what_the_drone_itself_needs_is_looked_at(
    tmp_path: Path, looked_at: list[Place], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def check_libraries(_libraries: object, sets: dict[str, str]) -> list[Finding]:
        asked.extend(sets)
        return []

    monkeypatch.setattr(examination, "check_libraries", check_libraries)

    list(examination.examine(MISSION, tmp_path, drone=5))

    assert asked == [], "neither the ground station's libraries nor the camera's"
    assert [(place.who, place.port) for place in looked_at] == [("metrics of drone 5", 9106), ("PX4 of drone 5", 14541)]


def test_a_drone_that_is_not_in_the_mission_is_named_with_those_that_are(tmp_path: Path) -> None:
    with pytest.raises(MissionError, match="there is no drone 4; the mission has 3, 5"):
        list(examination.examine(MISSION, tmp_path, drone=4))
