"""Scans fitted to their map: where the sensor was, what is refused, and that it can be repeated."""

from __future__ import annotations

import builtins
import math
from collections.abc import Mapping, Sequence
from types import ModuleType

import numpy as np
import pytest

from agents.localization.registration import (
    MAP_SD_M,
    OVERLAP_MIN,
    UNKNOWN_SD,
    ScanRegistration,
    load_kiss_icp,
    pose_covariance,
)
from protocol.errors import VehicleError
from protocol.geometry import Floats
from protocol.localization_settings import Lidar

LIDAR = Lidar()
LOW, HIGH = np.array([-3.0, -2.0, 0.0]), np.array([3.0, 2.0, 2.5])


def scan(pose: Sequence[float], seed: int) -> Floats:
    """(3000, 3) points of an empty room with a box in it, as a lidar at ``pose`` (4,) sees them, levelled."""
    dice = np.random.default_rng(seed)
    rays = dice.normal(0, 1, (3000, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    place = np.array(pose[:3])
    to_walls = np.where(rays > 0, (HIGH - place) / rays, (LOW - place) / rays).min(axis=1)
    points = rays * (to_walls + dice.normal(0, 0.01, 3000))[:, None]
    cosine, sine = math.cos(pose[3]), math.sin(pose[3])
    turned: Floats = points @ np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    return turned


def path(number: int) -> Floats:
    return np.array([0.04 * number, 0.5 - 0.02 * number, 1.2 + 0.01 * number, 0.3 + 0.02 * number])


def followed(scans: ScanRegistration, count: int) -> list[Floats]:
    """Poses of so many scans along `path`, each guessed 3 cm off."""
    found = []
    for number in range(count):
        guess = path(number) + ([0.0, 0.0, 0.0, 0.0] if number == 0 else [0.02, -0.02, 0.01, 0.01])
        result = scans.register(scan(path(number), number), guess)
        assert result.fits
        scans.keep(result.pose)
        found.append(result.pose)
    return found


def test_the_sensor_is_found_to_a_centimetre_from_guesses_three_off() -> None:
    found = np.array(followed(ScanRegistration(LIDAR), 12))
    errors = found - np.array([path(number) for number in range(12)])
    assert np.linalg.norm(errors[:, :3], axis=1).max() < 0.03
    assert np.linalg.norm(errors[4:, :3], axis=1).max() < 0.015, "once the map is dense"
    assert np.abs(errors[:, 3]).max() < 0.015


def test_the_same_scans_give_the_same_poses_to_the_last_bit() -> None:
    first, second = (np.array(followed(ScanRegistration(LIDAR), 6)).tobytes() for _ in range(2))
    assert first == second


def test_points_at_random_do_not_fit() -> None:
    scans = ScanRegistration(LIDAR)
    followed(scans, 4)
    result = scans.register(np.random.default_rng(0).uniform(-1.5, 1.5, (3000, 3)), path(4))
    assert not result.fits
    assert result.overlap < OVERLAP_MIN


@pytest.mark.parametrize("count", [0, 3])
def test_a_scan_of_next_to_nothing_says_nothing(count: int) -> None:
    scans = ScanRegistration(LIDAR)
    followed(scans, 2)
    result = scans.register(np.ones((count, 3)), path(2))
    assert not result.fits
    assert np.array_equal(result.pose, path(2))


def test_a_scan_that_was_not_kept_is_not_in_the_map() -> None:
    kept, refused = ScanRegistration(LIDAR), ScanRegistration(LIDAR)
    followed(kept, 3)
    followed(refused, 3)
    refused.register(np.random.default_rng(0).uniform(-1.5, 1.5, (3000, 3)), path(3))
    expected, found = (scans.register(scan(path(3), 3), path(3)) for scans in (kept, refused))
    assert np.array_equal(expected.pose, found.pose)
    assert expected.overlap == found.overlap


def test_over_a_bare_floor_height_is_known_and_nothing_else() -> None:
    dice = np.random.default_rng(0)
    floor = np.column_stack([dice.uniform(-1, 1, (3000, 2)), dice.normal(-1.5, 0.01, 3000)])
    covariance = ScanRegistration(LIDAR).register(floor, np.zeros(4)).covariance
    deviations = np.sqrt(np.diag(covariance))
    assert deviations[2] < 0.2
    assert deviations[:2].min() > 1.0
    assert deviations[3] > 1.0


def test_between_walls_everything_is_known() -> None:
    covariance = ScanRegistration(LIDAR).register(scan(path(0), 0), path(0)).covariance
    assert np.sqrt(np.diag(covariance)[:3]).max() < 2 * MAP_SD_M


def test_surfaces_without_number_say_nothing_rather_than_fail() -> None:
    covariance = pose_covariance(np.empty((0, 3)), np.empty((0, 3)), 1.0)
    assert np.sqrt(np.diag(covariance)) == pytest.approx(UNKNOWN_SD, rel=1e-3)


def test_without_kiss_icp_it_is_said_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    imported = builtins.__import__

    def without(
        name: str,
        globals_: Mapping[str, object] | None = None,
        locals_: Mapping[str, object] | None = None,
        fromlist: Sequence[str] | None = (),
        level: int = 0,
    ) -> ModuleType:
        if name.startswith("kiss_icp"):
            raise ModuleNotFoundError(name)
        return imported(name, globals_, locals_, fromlist, level)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(VehicleError, match=r"coverage-recon\[lidar\]"):
        load_kiss_icp()
