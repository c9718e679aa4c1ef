"""The rooms that the simulator writes for the learned reconstructor are what its training reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ground_station.reconstruction.learned.fragment import FINE_M, REACH_M
from ground_station.reconstruction.learned.training.lessons import STEPS, load_room
from protocol.geometry import Floats
from sim_bridge.scenes.surfaces import Material, Surfaces, box, join, quad
from sim_bridge.training_rooms import room_file
from sim_bridge.training_rooms.__main__ import main
from sim_bridge.training_rooms.sorties import CEILING_M, CLEARANCE_M, sortie

TOP_M = 0.6
"""Of the one piece of furniture, a crate in the middle."""


def crate_room(seed: int) -> tuple[Surfaces, list[np.ndarray[tuple[int, ...], np.dtype[np.uint8]]]]:
    rng = np.random.default_rng(seed)
    floor = quad([(-4, -4, 0), (4, -4, 0), (4, 4, 0), (-4, 4, 0)], Material(0))
    crate = box((1.2, 1.0, TOP_M), Material(0))
    return join([floor, crate]), [rng.integers(0, 255, (64, 64, 3), dtype=np.uint8)]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rooms")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(room_file, "random_room", crate_room)
        patch.setattr(room_file, "PHOTOGRAPHS", 40)
        arguments = ["--seeds", "7", "--voxel", str(FINE_M), "--reach", str(REACH_M)]
        assert main([str(folder), *arguments]) == 0
        written = (folder / "room-7.npz").read_bytes()
        assert main([str(folder), *arguments]) == 0
        assert (folder / "room-7.npz").read_bytes() == written, "what is there stays"
    return folder / "room-7.npz"


def test_a_room_holds_photographs_of_every_sortie(written: Path) -> None:
    room = load_room(written)
    assert room.images.shape == (2 * 40, room_file.HEIGHT, room_file.WIDTH, 3)
    assert np.bincount(room.sortie).tolist() == [40, 40]
    assert room.images.std() > 1


def test_distances_are_those_to_the_furniture(written: Path) -> None:
    room = load_room(written)
    middle = np.rint((np.array([0.0, 0.0, TOP_M]) - room.origin) / FINE_M).astype(int)
    height = room.origin[2] + FINE_M * middle[2] - TOP_M
    seen = room.distance[middle[0], middle[1]]
    assert seen[middle[2] + 1] == pytest.approx(STEPS * (height + FINE_M) / REACH_M, abs=1)
    assert seen[middle[2] + 6] == STEPS
    beside = np.rint((np.array([0.64, 0.0, 0.3]) - room.origin) / FINE_M).astype(int)
    assert abs(room.distance[tuple(beside)]) == pytest.approx(STEPS * 0.04 / REACH_M, abs=1)
    inside = np.rint((np.array([0.0, 0.0, 0.3]) - room.origin) / FINE_M).astype(int)
    assert room.distance[tuple(inside)] == -STEPS


def test_a_sortie_keeps_clear_of_things_and_hangs_on_its_dice_alone() -> None:
    def clearance(places: Floats) -> Floats:
        return np.where(np.hypot(places[:, 0], places[:, 1]) < 1.0, places[:, 2] - 1.8, 1.0)

    poses = sortie(np.random.default_rng(2), 80, clearance)
    assert poses.shape == (80, 5)
    assert (clearance(poses[:, :3]) >= CLEARANCE_M - 1e-9).all()
    assert poses[:, 2].max() < CEILING_M + 0.2
    steps = np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)
    assert np.median(steps) == pytest.approx(steps[0])
    assert np.array_equal(poses, sortie(np.random.default_rng(2), 80, clearance))
