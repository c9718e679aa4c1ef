"""Poses that are off by a known noise, of cameras over a floor with boxes, come closer to the truth."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from ground_station.reconstruction.pose_refiner import Pose, PoseRefiner
from protocol.geometry import Floats, Intrinsics, camera_rotation, rotation_vector, turn_matrix

CAMERA = Intrinsics.from_field_of_view(320, 180, 1.287)
SIGMA_M, SIGMA_RAD = 0.02, float(np.radians(0.5))
DEPTHS = (0.6, 2.5)
STEPS = 18
BOX_TOP_M = 0.4


@pytest.fixture(scope="module")
def ground() -> Floats:
    """(800, 800): a texture of 4 m x 4 m, 5 mm to a texel."""
    dice = np.random.default_rng(6)
    layers = [gaussian_filter(dice.normal(size=(800, 800)), width) for width in (1.5, 4.0, 12.0)]
    grey: Floats = np.clip(128 + sum(25 * layer / layer.std() for layer in layers), 0, 255)
    return grey


def photograph(ground: Floats, pose: Pose) -> NDArray[np.uint8]:
    """The floor z = 0, and a slab over its middle."""
    columns, rows = np.meshgrid(np.arange(CAMERA.width) + 0.5, np.arange(CAMERA.height) + 0.5)
    rays = np.stack([(columns - CAMERA.cx) / CAMERA.fx, (rows - CAMERA.cy) / CAMERA.fy, np.ones_like(rows)], axis=-1)
    rays = rays @ pose.rotation.T
    image = np.zeros(rows.shape)
    for height in (0.0, BOX_TOP_M):
        points = pose.position + rays * ((height - pose.position[2]) / rays[..., 2])[..., None]
        there = (np.abs(points[..., :2]) < 0.4).all(axis=-1) | (height == 0.0)
        place = (points[..., 1::-1] + 2 + 0.7 * height) / 0.005
        image = np.where(there, map_coordinates(ground, [place[..., 0], place[..., 1]], order=1, mode="wrap"), image)
    return image.astype(np.uint8)


def path(drone: int) -> list[Pose]:
    """Sideways over the slab; the second drone beside the first, the other way round."""
    along = np.linspace(-1.0, 1.0, STEPS) * (1 if drone == 1 else -1)
    return [
        Pose(
            np.array([x, 0.25 * drone - 0.4, 1.5 + 0.05 * np.sin(n)]), camera_rotation(0.3 * np.sin(n / 3) + drone, 1.4)
        )
        for n, x in enumerate(along)
    ]


def measured(true: Pose, drone: int, step: int) -> Pose:
    dice = np.random.default_rng([1, drone, step])
    turn = turn_matrix(dice.normal(0, SIGMA_RAD, 3))
    return Pose(true.position + dice.normal(0, SIGMA_M, 3), turn @ true.rotation)


def errors(true: Pose, found: Pose | None) -> Floats:
    """(6,) in standard deviations of the noise."""
    assert found is not None
    turn = rotation_vector(found.rotation @ true.rotation.T)
    return np.concatenate([(found.position - true.position) / SIGMA_M, turn / SIGMA_RAD])


def make() -> PoseRefiner:
    return PoseRefiner(64, CAMERA.width, CAMERA.height, SIGMA_M, SIGMA_RAD)


@pytest.fixture(scope="module")
def flight(ground: Floats) -> list[tuple[int, int, Pose, NDArray[np.uint8]]]:
    """Drone, step, true pose and image."""
    paths = {drone: path(drone) for drone in (1, 2)}
    return [(drone, n, paths[drone][n], photograph(ground, paths[drone][n])) for n in range(STEPS) for drone in (1, 2)]


def test_noise_is_more_than_halved_and_neighbours_agree_still_better(
    flight: list[tuple[int, int, Pose, NDArray[np.uint8]]],
) -> None:
    refiner = make()
    tickets = [
        refiner.add(drone, n, image, CAMERA, measured(true, drone, n), DEPTHS) for drone, n, true, image in flight
    ]
    assert None not in tickets
    found = np.array([errors(true, refiner.pose(t or 0)) for t, (_, _, true, _) in zip(tickets, flight, strict=True)])
    assert np.sqrt(np.mean(found**2)) < 0.5
    steps = (found[2:] - found[:-2]) / np.sqrt(2)  # from one keyframe of a drone to its next
    assert np.sqrt(np.mean(steps**2)) < 0.2


def test_exact_poses_hardly_move(flight: list[tuple[int, int, Pose, NDArray[np.uint8]]]) -> None:
    refiner = make()
    for drone, n, true, image in flight:
        ticket = refiner.add(drone, n, image, CAMERA, true, DEPTHS)
        assert ticket is not None
        assert np.abs(errors(true, refiner.pose(ticket))).max() < 0.25, "5 mm, or an eighth of a degree"


def test_a_pose_far_off_is_refused_and_the_next_is_not(flight: list[tuple[int, int, Pose, NDArray[np.uint8]]]) -> None:
    refiner = make()
    for number, (drone, n, true, image) in enumerate(flight):
        pose = measured(true, drone, n)
        if number in (13, 20, 21):
            turn = turn_matrix(np.array([0.0, 0.0, 0.2]))
            pose = Pose(pose.position + np.array([0.2, 0.1, 0.0]), turn @ pose.rotation)
        ticket = refiner.add(drone, n, image, CAMERA, pose, DEPTHS)
        assert (ticket is None) == (number in (13, 20, 21))


def test_a_place_not_seen_before_is_taken_as_it_is_measured(
    flight: list[tuple[int, int, Pose, NDArray[np.uint8]]],
) -> None:
    refiner = make()
    for drone, n, true, image in flight[:20]:
        refiner.add(drone, n, image, CAMERA, true, DEPTHS)
    away = Pose(np.array([9.0, 9.0, 1.5]), camera_rotation(0.0, 1.4))
    ticket = refiner.add(1, 99, flight[3][3], CAMERA, away, DEPTHS)
    assert ticket is not None
    assert errors(away, refiner.pose(ticket)) == pytest.approx(np.zeros(6), abs=1e-6)


def test_only_the_newest_are_known(flight: list[tuple[int, int, Pose, NDArray[np.uint8]]]) -> None:
    refiner = PoseRefiner(8, CAMERA.width, CAMERA.height, SIGMA_M, SIGMA_RAD)
    tickets = [refiner.add(drone, n, image, CAMERA, true, DEPTHS) for drone, n, true, image in flight[:20]]
    assert tickets == list(range(20))
    assert [refiner.pose(ticket) is None for ticket in range(20)] == [True] * 13 + [False] * 7
    size = refiner.size_bytes
    refiner.add(*flight[20][:2], flight[20][3], CAMERA, flight[20][2], DEPTHS)
    assert refiner.size_bytes == size
