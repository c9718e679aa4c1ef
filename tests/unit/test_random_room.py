import itertools
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from protocol.errors import SceneError
from sim_bridge.scenes.arrangement import CLEARANCE_M, Piece, fits, gap, piece
from sim_bridge.scenes.random_room import FURNISHED_M, furnish, random_room
from sim_bridge.scenes.scene import load_scene, seed_of
from sim_bridge.scenes.surfaces import Material, Surfaces, box

SEEDS = range(30)
TRIANGLES_MOST = 40_000
"""Twice the living room: what baking and every photograph cost grows with them."""


@cache
def furniture(seed: int) -> list[Piece]:
    return furnish(np.random.default_rng(seed))


def square(x: float, y: float, yaw_deg: float = 0.0) -> Piece:
    return piece("box", box((1.0, 1.0, 1.0), Material(0))).moved(x, y, yaw_deg)


def same(one: Surfaces, other: Surfaces) -> bool:
    names = ("triangles", "uv", "colour", "texture", "two_sided")
    return all(getattr(one, name).tobytes() == getattr(other, name).tobytes() for name in names)


def test_a_seed_gives_the_same_bytes_and_another_seed_another_room() -> None:
    first, first_images = random_room(3)
    again, again_images = random_room(3)
    other, other_images = random_room(4)
    assert same(first, again)
    assert all(np.array_equal(*pair) for pair in zip(first_images, again_images, strict=True))
    assert not same(first, other)
    assert not any(np.array_equal(*pair) for pair in zip(first_images, other_images, strict=True))


def test_no_two_of_thirty_rooms_are_furnished_alike() -> None:
    places = {tuple(each.footprint.round(3).ravel().tolist()) for seed in SEEDS for each in furniture(seed)}
    assert len(places) == sum(len(furniture(seed)) for seed in SEEDS)
    assert len({tuple(sorted(each.name for each in furniture(seed))) for seed in SEEDS}) > len(SEEDS) // 2


@pytest.mark.parametrize("seed", SEEDS)
def test_furniture_stands_within_the_target_box_and_nothing_overlaps(seed: int) -> None:
    placed = furniture(seed)
    for each in placed:
        corners = each.surfaces.triangles.reshape(-1, 3)
        assert np.abs(corners[:, :2]).max() <= FURNISHED_M
        assert corners[:, 2].min() >= -1e-9
        assert corners[:, 2].max() <= 2.0
        assert _outside(corners[:, :2], each.footprint).max() < 1e-9
    standing = [each for each in placed if each.name != "rug"]
    for one, other in itertools.combinations(standing, 2):
        corners = one.surfaces.triangles[..., :2].reshape(-1, 2)
        assert _outside(corners, other.footprint).min() > 0.0, (one.name, other.name)
        assert gap(one.footprint, other.footprint) >= CLEARANCE_M


def _outside(points: np.ndarray, rectangle: np.ndarray) -> np.ndarray:
    """How far each point lies beyond the farthest of the rectangle's sides; negative inside."""
    sides = np.roll(rectangle, -1, axis=0) - rectangle
    outwards = np.column_stack([sides[:, 1], -sides[:, 0]]) / np.linalg.norm(sides, axis=1, keepdims=True)
    return (points @ outwards.T - (rectangle * outwards).sum(axis=1)).max(axis=1)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_room_is_furnished_with_a_mix_and_stays_light_enough_to_bake(seed: int) -> None:
    placed = furniture(seed)
    names = [each.name for each in placed]
    assert len(placed) >= 10
    assert len(set(names)) >= 9
    assert names.count("rug") == 1
    assert {"sofa", "coffee table", "dining table", "bookshelf", "sideboard", "parcels"} <= set(names)
    assert 5_000 < sum(len(each.surfaces.triangles) for each in placed) < TRIANGLES_MOST


def test_tall_furniture_keeps_to_the_edge_where_drones_keep_clear_of_it() -> None:
    for seed in SEEDS:
        for each in furniture(seed):
            tall = each.surfaces.triangles[each.surfaces.triangles[..., 2].max(axis=1) > 1.4]
            assert not len(tall) or np.abs(tall[..., :2]).max(axis=-1).min() > 2.0


def test_the_gap_between_rectangles_is_seen_along_any_of_their_sides() -> None:
    assert gap(square(0, 0).footprint, square(1.5, 0).footprint) == pytest.approx(0.5)
    assert gap(square(0, 0).footprint, square(0.9, 0.9).footprint) == pytest.approx(-0.1)
    # The turned square's corner points at the other's side: bounding boxes of 45 degrees would overlap.
    assert gap(square(0, 0).footprint, square(1.0, 1.0, 45.0).footprint) == pytest.approx(2**0.5 / 2 - 0.5, abs=0.01)


def test_a_group_fits_only_within_the_room_and_clear_of_what_stands_there() -> None:
    assert fits([square(0, 0)], [square(1.1, 0)], 3.0)
    assert not fits([square(0, 0)], [square(1.01, 0)], 3.0)
    assert not fits([square(2.6, 0)], [], 3.0)
    assert not fits([square(0, 0), square(0.5, 0)], [], 3.0)


@pytest.mark.parametrize("name", ["living_room", "room-1.glb", "rooms/room-1", "room", "bedroom-1"])
def test_other_names_are_no_random_room(name: str) -> None:
    assert seed_of(name) is None


def test_a_random_room_is_named_by_its_seed() -> None:
    assert [seed_of(name) for name in ("room-0", "room-7", "room-123456789")] == [0, 7, 123456789]


def test_a_random_room_is_built_for_its_seed_once_and_kept_by_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seeds: list[int] = []

    def small_room(seed: int) -> tuple[Surfaces, list[np.ndarray]]:
        seeds.append(seed)
        return box((1.0 + seed, 1.0, 1.0), Material(0)), [np.full((1, 1, 3), 255, np.uint8)]

    monkeypatch.setattr("sim_bridge.scenes.random_room.random_room", small_room)
    scenes = [load_scene(name, relative_to=tmp_path, cache=tmp_path) for name in ("room-7", "room-2", "room-7")]
    assert seeds == [7, 2]
    assert scenes[0].fingerprint == scenes[2].fingerprint != scenes[1].fingerprint
    assert sorted(path.name[:7] for path in tmp_path.iterdir()) == ["room-2-", "room-7-"]


@pytest.mark.parametrize("name", ["room-x", "room-", "room--1", "room-07", "room-1e3", "room-1234567890", "room-٣"])
def test_a_name_that_only_begins_like_a_random_room_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=rf"{name}: a random room is named room-<seed>"):
        load_scene(name, relative_to=tmp_path, cache=tmp_path)
