"""A record is read as it was written or not at all, and whatever is wrong with a file is seen."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from faults.disk import FullDisk
from ground_station.record_file import HEAD_BYTES, MARK, GrowingFile, Layout, lay_out, record

CONTENTS = st.lists(st.binary(min_size=1, max_size=40), max_size=6)
BEFORE = b"header"
"""What stands before the records, and need not be looked at."""


def written(contents: list[bytes]) -> bytes:
    return BEFORE + b"".join(map(record, contents))


def read(data: bytes) -> tuple[list[bytes], Layout]:
    layout = lay_out(data, len(BEFORE))
    return [data[span.first : span.last] for span in layout.contents], layout


@given(CONTENTS)
def test_records_are_found_as_they_were_written(contents: list[bytes]) -> None:
    data = written(contents)
    found, layout = read(data)
    assert found == contents
    assert (layout.damaged, layout.end) == ((), len(data))


@given(CONTENTS, st.binary(min_size=1, max_size=40))
def test_a_record_torn_at_any_byte_is_no_damage_and_costs_itself_alone(contents: list[bytes], last: bytes) -> None:
    whole, kept = written([*contents, last]), written(contents)
    for size in range(len(kept), len(whole)):
        found, layout = read(whole[:size])
        assert found == contents
        assert (layout.damaged, layout.end) == ((), len(kept))


@given(CONTENTS, st.integers(0, HEAD_BYTES - 1), st.integers(1, 5000))
def test_room_for_bytes_that_never_came_is_no_damage(contents: list[bytes], came: int, room: int) -> None:
    kept = written(contents)
    found, layout = read(kept + record(b"lost")[:came] + bytes(room))
    assert found == contents
    assert layout.end == len(kept)
    assert layout.damaged == ()


@given(st.lists(st.binary(min_size=1, max_size=40), min_size=1, max_size=6), st.data())
def test_a_changed_byte_costs_its_record_alone_and_is_told_unless_a_crash_can_have_done_it(
    contents: list[bytes], choice: st.DataObject
) -> None:
    data = bytearray(written(contents))
    place = choice.draw(st.integers(len(BEFORE), len(data) - 1))
    data[place] ^= choice.draw(st.integers(1, 255))
    ends = [len(written(contents[: number + 1])) for number in range(len(contents))]
    hit = next(number for number, end in enumerate(ends) if place < end)

    found, layout = read(bytes(data))

    assert found == contents[:hit] + contents[hit + 1 :]
    first = len(written(contents[:hit]))
    if hit < len(contents) - 1:
        assert [(span.first, span.last) for span in layout.damaged] == [(first, ends[hit])]
    elif layout.damaged:
        assert [(span.first, span.last) for span in layout.damaged] == [(first, len(data))]
        assert layout.end == len(data), "what is damaged is not written over"
    else:
        assert place >= first + HEAD_BYTES or not any(data[first + HEAD_BYTES - 1 :])


@given(CONTENTS, st.binary(min_size=1, max_size=60), st.lists(st.binary(min_size=1, max_size=40), min_size=1))
def test_reading_goes_on_behind_bytes_that_do_not_belong_there(
    contents: list[bytes], alien: bytes, more: list[bytes]
) -> None:
    data = written(contents) + alien + b"".join(map(record, more))
    found, layout = read(data)
    assert found == contents + more
    assert len(layout.damaged) == 1
    assert layout.end == len(data)


def test_marks_inside_of_damage_do_not_hide_what_follows() -> None:
    data = written([b"one"]) + MARK * 5 + record(b"torn")[:-1] + record(b"two")
    found, layout = read(data)
    assert found == [b"one", b"two"]
    assert len(layout.damaged) == 1


def test_a_length_beyond_the_file_is_a_torn_record_only_if_nothing_follows() -> None:
    torn = record(bytes(500))[:100]
    assert read(written([b"one"]) + torn)[1].damaged == ()
    found, layout = read(written([b"one"]) + torn + record(b"two"))
    assert found == [b"one", b"two"]
    assert len(layout.damaged) == 1


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "file"


@pytest.mark.parametrize("room", [0, 1, 4])
def test_an_append_that_failed_is_overwritten_by_the_next(path: Path, room: int) -> None:
    file = GrowingFile(path)
    file.append(b"first")
    disk = file._file
    file._file = FullDisk(disk, room)  # type: ignore[assignment]
    with pytest.raises(OSError, match="No space left"):
        file.append(b"refused")
    assert file.end == 5
    file._file = disk
    file.append(b"2nd")
    file.close()
    assert path.read_bytes() == b"first2nd"


def test_a_disk_that_writes_piecemeal_gets_every_byte(path: Path) -> None:
    file = GrowingFile(path)
    file._file = FullDisk(file._file, 10**6, piece=7)  # type: ignore[assignment]
    file.append(b"abc" * 100)
    file.close()
    assert path.read_bytes() == b"abc" * 100


def test_an_empty_file_has_no_contents(path: Path) -> None:
    file = GrowingFile(path)
    with file.contents() as data:
        assert lay_out(data) == Layout((), (), 0)
    file.close()
