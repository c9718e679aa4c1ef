"""A checkpoint is read back as it was saved, or the one before it is, whatever happens to the process or the disk."""

from __future__ import annotations

import functools
import logging
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from faults.disk import dies, in_child
from ground_station.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from ground_station.mapper import MapState
from protocol.errors import MissionError, StorageError
from protocol.mission import Drone, Mission

MISSION = Mission(name="alone", drones=(Drone(id=1, start=(0.0, 1.0, 2.0, 0.0, 1.4)),))


def checkpoint(number: int) -> Checkpoint:
    arrays = {
        "weight": np.arange(number % 7, dtype=np.float32),
        "color": np.full((2, 3), number, np.uint8),
        "waiting": np.empty((0, 2), np.int64),
        "fused": np.array(number),
        "mask": np.array([True, False]),
    }
    return Checkpoint(
        epoch=2**61 + number,
        tick=20 * number,
        next_sequence=number,
        phi=np.full((3, 2), number, np.float32),
        map=MapState(reconstruction=arrays, first=5 * number, end=9 * number, unreadable=number),
        totals={"keyframes": number, "min_separation_m": 1.25, "wall_s": 0.1},
    )


def plain(number: int) -> Checkpoint:
    return replace(checkpoint(number), map=MapState({}, number, number, 0))


def assert_equal(found: Checkpoint | None, expected: Checkpoint) -> None:
    assert found is not None
    for name in ("epoch", "tick", "next_sequence", "totals"):
        assert getattr(found, name) == getattr(expected, name)
    for name in ("first", "end", "unreadable"):
        assert getattr(found.map, name) == getattr(expected.map, name)
    assert list(found.map.reconstruction) == list(expected.map.reconstruction)
    pairs = [(found.phi, expected.phi)]
    pairs += [(found.map.reconstruction[name], array) for name, array in expected.map.reconstruction.items()]
    for one, other in pairs:
        assert (one.dtype, one.shape, one.tobytes()) == (other.dtype, other.shape, other.tobytes())
        assert one.flags.writeable


def test_without_a_checkpoint_there_is_none(tmp_path: Path) -> None:
    assert load_checkpoint(tmp_path, MISSION) is None


def test_the_newest_checkpoint_is_read_back_as_it_was_saved(tmp_path: Path) -> None:
    for number in range(4):
        save_checkpoint(tmp_path, MISSION, checkpoint(number))
        assert_equal(load_checkpoint(tmp_path, MISSION), checkpoint(number))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["checkpoint", "checkpoint.previous"]


def test_equal_checkpoints_are_equal_bytes(tmp_path: Path) -> None:
    for _ in range(2):
        save_checkpoint(tmp_path, MISSION, checkpoint(3))
    assert (tmp_path / "checkpoint").read_bytes() == (tmp_path / "checkpoint.previous").read_bytes()


def test_arrays_in_any_layout_and_byte_order_are_saved_by_their_values(tmp_path: Path) -> None:
    phi = np.arange(6, dtype=">f4").reshape(2, 3).T
    odd = Checkpoint(1, 2, 3, phi, MapState({}, 0, 0, 0), {"never": math.inf})  # type: ignore[arg-type]
    save_checkpoint(tmp_path, MISSION, odd)
    found = load_checkpoint(tmp_path, MISSION)
    assert found is not None
    assert found.phi.dtype == np.float32
    assert found.phi.tolist() == phi.tolist()
    assert found.totals == {"never": math.inf}


def test_a_checkpoint_of_another_mission_is_refused_and_left_alone(tmp_path: Path) -> None:
    save_checkpoint(tmp_path, MISSION, checkpoint(1))
    before = (tmp_path / "checkpoint").read_bytes()
    with pytest.raises(MissionError, match="checkpoint: is of another mission"):
        load_checkpoint(tmp_path, MISSION.model_copy(update={"seed": 2}))
    assert (tmp_path / "checkpoint").read_bytes() == before


def assert_the_one_before_is_used(folder: Path, damaged: bytes, caplog: pytest.LogCaptureFixture) -> None:
    caplog.clear()
    (folder / "checkpoint").write_bytes(damaged)
    assert_equal(load_checkpoint(folder, MISSION), checkpoint(1))
    aside = folder / "checkpoint.damaged-1"
    assert aside.read_bytes() == damaged
    assert [entry.levelno for entry in caplog.records] == [logging.ERROR]
    assert "it is now checkpoint.damaged-1" in caplog.text
    aside.unlink()


def save_two(folder: Path) -> bytes:
    save_checkpoint(folder, MISSION, checkpoint(1))
    save_checkpoint(folder, MISSION, checkpoint(2))
    return (folder / "checkpoint").read_bytes()


def test_a_checkpoint_cut_at_any_byte_is_set_aside_and_the_one_before_is_used(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    whole = save_two(tmp_path)
    for size in range(len(whole)):
        assert_the_one_before_is_used(tmp_path, whole[:size], caplog)


def test_a_checkpoint_with_a_flipped_bit_is_set_aside_and_the_one_before_is_used(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    whole = save_two(tmp_path)
    for place in range(len(whole)):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << place % 8
        assert_the_one_before_is_used(tmp_path, bytes(damaged), caplog)


@pytest.mark.parametrize("more", [b"\0", b"\0" * 4096, b"more"])
def test_a_checkpoint_that_something_follows_is_damaged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, more: bytes
) -> None:
    assert_the_one_before_is_used(tmp_path, save_two(tmp_path) + more, caplog)


@given(content=st.binary(max_size=100))
def test_whatever_bytes_are_there_in_place_of_both_the_ground_station_can_start(
    tmp_path_factory: pytest.TempPathFactory, content: bytes
) -> None:
    folder = tmp_path_factory.mktemp("bytes")
    for name in ("checkpoint", "checkpoint.previous"):
        (folder / name).write_bytes(content)
    assert load_checkpoint(folder, MISSION) is None
    assert sorted(path.name for path in folder.iterdir()) == ["checkpoint.damaged-1", "checkpoint.previous.damaged-1"]


def test_a_crash_anywhere_while_saving_leaves_the_one_before_or_the_new_one(tmp_path: Path) -> None:
    def save(folder: Path, number: int) -> None:
        save_checkpoint(folder, MISSION, plain(number))

    step, found = 0, []
    while True:
        folder = tmp_path / str(step)
        folder.mkdir()
        save(folder, 1)
        save(folder, 2)
        died = dies(functools.partial(save, folder, 3), step)
        newest = load_checkpoint(folder, MISSION)
        assert newest is not None
        assert_equal(newest, plain(newest.next_sequence))
        found.append(newest.next_sequence)
        assert not list(folder.glob("*damaged*"))
        save(folder, 4)  # over the draft that the crash may have left
        assert_equal(load_checkpoint(folder, MISSION), plain(4))
        (folder / "checkpoint").write_bytes(b"")
        assert_equal(load_checkpoint(folder, MISSION), plain(newest.next_sequence))
        if not died:
            break
        step += 1
    assert found == sorted(found)
    assert set(found) == {2, 3}


def test_a_full_disk_is_an_error_and_what_was_saved_stays(tmp_path: Path) -> None:
    save_checkpoint(tmp_path, MISSION, checkpoint(1))

    def save() -> None:
        with pytest.raises(StorageError, match="checkpoint: File too large"):
            save_checkpoint(tmp_path, MISSION, checkpoint(2))

    assert in_child(save, largest_file=300) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint"]
    assert_equal(load_checkpoint(tmp_path, MISSION), checkpoint(1))


def test_a_folder_that_is_gone_is_an_error_when_saving(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="No such file"):
        save_checkpoint(tmp_path / "gone", MISSION, checkpoint(1))
