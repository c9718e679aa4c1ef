"""Poses and points that are known exactly are found again from what cameras would see of them."""

from __future__ import annotations

import numpy as np
import pytest

from ground_station.reconstruction.bundle import SIGHTINGS_MAX, Landmarks, Prior, adjust, sighting_errors
from protocol.geometry import Floats, camera_rotation, rotation_vector, turn_matrix

FOCAL = 200.0
VIEWS, POINTS = 8, 120
SIGMA_M, SIGMA_RAD = 0.02, 0.01


class Bench:
    """A row of cameras over a rough floor; each sees all points, the first has them as landmarks."""

    def __init__(self, noise_px: float = 0.0, wrong: int = 0) -> None:
        dice = np.random.default_rng(2)
        self.position = np.column_stack([0.12 * np.arange(VIEWS), 0.05 * np.cos(np.arange(VIEWS)), np.full(VIEWS, 1.6)])
        self.rotation = np.array([camera_rotation(0.2 * np.sin(n), 1.4 + 0.1 * np.cos(n)) for n in range(VIEWS)])
        rays = np.column_stack([dice.uniform(-0.5, 0.5, (POINTS, 2)), np.ones(POINTS)])
        self.inverse_depth = 1 / dice.uniform(1.0, 1.7, POINTS)
        points = self.position[0] + (rays @ self.rotation[0].T) / self.inverse_depth[:, None]
        view = np.zeros((POINTS, SIGHTINGS_MAX), np.int16)
        place = np.zeros((POINTS, SIGHTINGS_MAX, 2))
        for n in range(1, VIEWS):
            local = (points - self.position[n]) @ self.rotation[n]
            view[:, n - 1], place[:, n - 1] = n, local[:, :2] / local[:, 2:]
        place += dice.normal(0, noise_px / FOCAL, place.shape)
        place[:wrong] += np.random.default_rng(3).uniform(-30, 30, (wrong, SIGHTINGS_MAX, 2)) / FOCAL
        anchor, count = np.zeros(POINTS, np.int64), np.full(POINTS, VIEWS - 1, np.int64)
        self.landmarks = Landmarks(anchor, rays, np.full(POINTS, 1 / 1.35), count, view, place)
        measured = self.position + dice.normal(0, SIGMA_M, (VIEWS, 3))
        turned = np.array([turn_matrix(dice.normal(0, SIGMA_RAD, 3)) @ rotation for rotation in self.rotation])
        self.prior = Prior(measured, turned, SIGMA_M, SIGMA_RAD)
        self.found_position, self.found_rotation = measured.copy(), turned.copy()

    def solve(self, free: list[int]) -> None:
        for doubted in (12.0, 6.0, 3.0, 2.0, 2.0, 2.0):
            adjust(
                self.found_position, self.found_rotation, np.full(VIEWS, FOCAL), np.array(free), self.prior,
                self.landmarks, doubted,
            )  # fmt: skip

    def errors(self) -> tuple[Floats, Floats]:
        """(V,) m and rad."""
        turns = [rotation_vector(a @ b.T) for a, b in zip(self.found_rotation, self.rotation, strict=True)]
        return np.linalg.norm(self.found_position - self.position, axis=1), np.linalg.norm(turns, axis=1)


def test_the_pose_of_one_view_is_found_from_those_of_the_others() -> None:
    bench = Bench()
    bench.found_position[:-1], bench.found_rotation[:-1] = bench.position[:-1], bench.rotation[:-1]
    bench.solve([VIEWS - 1])
    shift, turn = bench.errors()
    assert shift[-1] < 0.002, "of 3.5 cm"
    assert turn[-1] < 0.001, "of 1 degree"
    assert bench.landmarks.inverse_depth == pytest.approx(bench.inverse_depth, rel=0.002)


def test_the_errors_of_independent_measurements_cancel_out() -> None:
    bench = Bench(noise_px=0.3)
    before = np.sqrt(np.mean(np.square(bench.errors()), axis=1))
    bench.solve(list(range(VIEWS)))
    after = np.sqrt(np.mean(np.square(bench.errors()), axis=1))
    assert (after < 0.55 * before).all(), "a mean of eight has 0.35 of the error"


def test_wrong_sightings_do_no_harm() -> None:
    clean, spoiled = Bench(noise_px=0.3), Bench(noise_px=0.3, wrong=POINTS // 4)
    for bench in (clean, spoiled):
        bench.solve(list(range(VIEWS)))
    assert spoiled.found_position == pytest.approx(clean.found_position, abs=0.005)
    errors = sighting_errors(
        spoiled.found_position, spoiled.found_rotation, np.full(VIEWS, FOCAL), spoiled.landmarks
    )  # fmt: skip
    assert np.median(errors[: POINTS // 4, : VIEWS - 1]) > 3.0
    assert np.quantile(errors[POINTS // 4 :, : VIEWS - 1], 0.95) < 1.5


def test_without_sightings_poses_return_to_where_they_were_measured() -> None:
    bench = Bench()
    bench.landmarks.count[:] = 0
    bench.found_position[:], bench.found_rotation[:] = bench.position, bench.rotation
    bench.solve([2, 5])
    assert bench.found_position[[2, 5]] == pytest.approx(bench.prior.position[[2, 5]])
    assert bench.found_rotation[[2, 5]] == pytest.approx(bench.prior.rotation[[2, 5]], abs=1e-6)
    assert (bench.found_position[3] == bench.position[3]).all(), "held fixed"
