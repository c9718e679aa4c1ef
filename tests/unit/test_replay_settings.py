"""What a replay may change, and how it says what it may not."""

from __future__ import annotations

import pytest

from ground_station.replay.settings import with_settings
from protocol.errors import MissionError
from protocol.map_settings import Cylinder
from protocol.mission import Drone, Mission

FLOWN = Mission(drones=(Drone(id=1, start=(0, 0, 2, 0, 1.4)),))


def test_settings_are_changed_and_all_others_stay() -> None:
    settings = ["feedback.kappa=0.5", "reconstruction.backend=none", "target.lower_m = [-1, -1, 0]"]

    changed = with_settings(FLOWN, settings)

    assert changed.feedback == FLOWN.feedback.model_copy(update={"kappa": 0.5})
    assert changed.reconstruction.backend == "none"
    assert changed.target.lower_m == (-1, -1, 0)
    assert changed.flight == FLOWN.flight


def test_a_setting_in_a_table_of_a_table_can_be_changed() -> None:
    changed = with_settings(
        FLOWN, ["feedback.method=m3c2", "feedback.cylinder.radius_m=0.02", "feedback.cylinder.half_length_m=0.1"]
    )

    assert changed.feedback.method == "m3c2"
    assert changed.feedback.cylinder == Cylinder(radius_m=0.02, half_length_m=0.1)


def test_a_value_that_it_has_already_changes_nothing() -> None:
    assert with_settings(FLOWN, [f"feedback.gain={FLOWN.feedback.gain}"]) == FLOWN


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("feedback.kapa=0.5", "feedback.kapa: unknown key, did you mean kappa?"),
        ("feedback.kappa=0", "feedback.kappa: must be greater than 0, got 0"),
        ("feedback.kappa=high", 'feedback.kappa: must be a valid number, got "high"'),
        ("feedback.method=nerf", "feedback.method: must be 'grid', 'm3c2' or 'none', got \"nerf\""),
        (
            "feedback.cylinder.radius_m=0.1",
            "feedback.cylinder: half_length_m 0.25 must be an odd multiple of radius_m 0.1",
        ),
        ("feedback.kappa.x=1", "feedback.kappa.x: kappa is no table"),
        ("feedback=1", "feedback=1: must be like feedback.kappa=0.5"),
        ("feedback.kappa", "feedback.kappa: must be like feedback.kappa=0.5"),
        (
            "flight.speed_max_mps=1",
            "flight.speed_max_mps: is flown already; a replay can change feedback, reconstruction, sensing, target",
        ),
        ("seed=2", "seed=2: must be like feedback.kappa=0.5"),
    ],
)
def test_a_setting_that_cannot_be_is_refused_in_words(setting: str, message: str) -> None:
    with pytest.raises(MissionError) as caught:
        with_settings(FLOWN, [setting])

    assert str(caught.value).startswith(message)


def test_all_faults_are_told_at_once() -> None:
    with pytest.raises(MissionError) as caught:
        with_settings(FLOWN, ["feedback.kapa=0.5", "feedback.kappa=-1", "sensing.distance_m=0"])

    assert len(str(caught.value).splitlines()) == 3
