"""Every keyframe that the disk took can be read again, and the flight goes on without the others."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from faults.disk import FullDisk, dies, in_child
from ground_station.keyframe_log import KeyframeLog
from ground_station.record_file import HEAD_BYTES, record
from protocol.errors import StorageError
from protocol.messages import Keyframe
from protocol.wire import decode


def keyframe(number: int) -> Keyframe:
    return Keyframe(
        drone=1 + number % 2,
        sequence=number // 2,
        tick=3 * number,
        position=(0.1 * number, 0.0, 2.0),
        rotation=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        width=32,
        height=32,
        fx=20.0,
        fy=20.0,
        cx=16.0,
        cy=16.0,
        jpeg=bytes([number]) * (5 + number),
    )


FLOWN = [keyframe(number) for number in range(6)]


def read(path: Path, first: int = 0) -> list[Keyframe]:
    with KeyframeLog(path) as log:
        return [found for _, found in log.read(first, log.end)]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "keyframes"
    with KeyframeLog(path) as log:
        for each in FLOWN[:5]:
            log.append(each)
    return path


def test_keyframes_are_there_again_after_reopening_and_more_can_follow(path: Path) -> None:
    with KeyframeLog(path) as log:
        assert log.count == 5
        assert log.end == path.stat().st_size
        log.append(FLOWN[5])
        assert log.count == 6
    assert read(path) == FLOWN


def test_a_range_begins_at_a_position_and_ends_before_another(path: Path) -> None:
    with KeyframeLog(path) as log:
        positions = [position for position, _ in log.read(0, log.end)]
        for first in range(5):
            for last in range(first, 5):
                found = [each for _, each in log.read(positions[first], positions[last])]
                assert found == FLOWN[first:last]
        assert list(log.read(log.end, log.end)) == []


def test_a_keyframe_torn_at_any_byte_costs_itself_alone(path: Path) -> None:
    whole = path.read_bytes()
    with KeyframeLog(path) as log:
        last = max(position for position, _ in log.read(0, log.end))
    for size in range(last, len(whole)):
        path.write_bytes(whole[:size])
        with KeyframeLog(path) as log:
            assert (log.count, log.end) == (4, last)
            log.append(FLOWN[5])
        assert read(path) == [*FLOWN[:4], FLOWN[5]]


def test_a_flipped_bit_anywhere_costs_one_keyframe_and_is_told(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    whole = path.read_bytes()
    with KeyframeLog(path) as log:
        starts = [position for position, _ in log.read(0, log.end)]
    for place in range(len(whole)):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << place % 8
        path.write_bytes(damaged)
        caplog.clear()
        hit = max(number for number, start in enumerate(starts) if start <= place)
        with KeyframeLog(path) as log:
            log.append(FLOWN[5])
        assert read(path) == [*FLOWN[:hit], *FLOWN[hit + 1 : 5], FLOWN[5]]
        assert hit == 4 or "keyframes are lost" in caplog.text


def test_records_that_are_no_keyframes_are_left_out(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with path.open("ab") as file:
        file.write(record(b"another message"))
    with KeyframeLog(path) as log:
        log.append(FLOWN[5])
    assert read(path) == FLOWN
    assert "is left out" in caplog.text


def test_a_full_disk_is_told_once_and_counted_and_its_end_as_well(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with KeyframeLog(path) as log:
        disk, end = log._file._file, log.end
        log._file._file = FullDisk(disk, HEAD_BYTES + 3)  # type: ignore[assignment]
        for _ in range(20):
            log.append(FLOWN[5])
        assert (log.lost_records, log.count, log.end) == (20, 5, end)
        assert [entry.levelname for entry in caplog.records] == ["ERROR"]
        assert "No space left" in caplog.text
        log._file._file = disk
        log.append(FLOWN[5])
        log.append(FLOWN[0])
        assert log.lost_records == 20
    assert [entry.levelname for entry in caplog.records] == ["ERROR", "WARNING"]
    assert "after 20 refusals" in caplog.text
    assert read(path) == [*FLOWN, FLOWN[0]]


def test_a_file_that_may_not_grow_loses_keyframes_and_nothing_else(path: Path) -> None:
    def append() -> None:
        with KeyframeLog(path) as log:
            for _ in range(3):
                log.append(FLOWN[5])
            assert log.lost_records == 3

    assert in_child(append, largest_file=path.stat().st_size + 10) == 0
    assert read(path) == FLOWN[:5]


def test_a_process_that_dies_anywhere_loses_at_most_the_keyframe_that_it_was_writing(path: Path) -> None:
    whole = path.read_bytes()

    def append() -> None:
        with KeyframeLog(path) as log:
            log.append(FLOWN[5])
            log.append(FLOWN[0])

    step, counts = 0, []
    while True:
        path.write_bytes(whole)
        died = dies(append, step)
        found = read(path)
        assert found == [*FLOWN, FLOWN[0]][: len(found)]
        counts.append(len(found))
        if not died:
            break
        step += 1
    assert counts == sorted(counts)
    assert set(counts) == {5, 6, 7}


def test_a_folder_in_its_place_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="Is a directory"):
        KeyframeLog(tmp_path)


def test_a_disk_that_does_not_sync_is_an_error_to_who_relies_on_it(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    with KeyframeLog(path) as log:
        log.sync()
        monkeypatch.setattr(os, "fdatasync", fail)
        with pytest.raises(StorageError, match="Input/output error"):
            log.sync()


def test_pages_of_keyframes_as_they_travelled_hold_each_once(tmp_path: Path) -> None:
    with KeyframeLog(tmp_path / "keyframes") as log:
        for one in FLOWN:
            log.append(one)
        place, found = 0, []
        while place < log.end:
            contents, place = log.page(place, log.end, 300)
            assert 1 <= len(contents) <= 2
            found += contents
        assert [decode(Keyframe, content) for content in found] == FLOWN
        assert log.page(log.end, log.end, 300) == ([], log.end)


def test_a_page_leaves_out_what_is_damaged_and_ends_where_it_is_told_to(tmp_path: Path) -> None:
    path = tmp_path / "keyframes"
    with KeyframeLog(path) as log:
        places = []
        for one in FLOWN:
            places.append(log.end)
            log.append(one)
        with path.open("r+b") as file:
            file.seek(places[2] + HEAD_BYTES + 3)
            file.write(b"\xff\xff")
        contents, place = log.page(places[1], places[5], 10_000)
        assert [decode(Keyframe, content) for content in contents] == [FLOWN[1], FLOWN[3], FLOWN[4]]
        assert place == places[5]
        contents, place = log.page(places[2], places[5], 50)
        assert decode(Keyframe, contents[0]) == FLOWN[3]
