"""No jump that anybody may have heard of is ever lost, whatever happens to the process or the disk."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ground_station.journal import Journal
from protocol.errors import JournalError
from protocol.guard import ROOT
from protocol.messages import Jump
from protocol.wire import decode

TORN_WITHIN_A_HEAD = 5
"""Bytes: more than nothing, less than a record's length and checksums."""


def jump(epoch: int, sequence: int) -> Jump:
    increments = np.arange(sequence % 3 + 1, dtype=np.float32) + sequence
    return Jump(epoch=epoch, sequence=sequence, tick=10 * sequence, increments=increments)


def fill(path: Path, count: int) -> list[bytes]:
    """A journal of so many jumps; what was published of them."""
    with Journal(path) as journal:
        return [journal.append(jump(journal.epoch, journal.next_sequence)) for _ in range(count)]


def reopen(path: Path) -> tuple[bytes, ...]:
    with Journal(path) as journal:
        return journal.encoded(0, journal.next_sequence)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "journal"


def test_jumps_are_there_again_after_reopening_and_the_epoch_stays(path: Path) -> None:
    published = fill(path, 3)
    with Journal(path) as journal:
        epoch = journal.epoch
        published.append(journal.append(jump(epoch, 3)))

    with Journal(path) as journal:
        assert journal.epoch == epoch
        assert journal.next_sequence == 4
        assert list(journal.encoded(0, 4)) == published
        assert [(each.epoch, each.sequence, each.tick) for each in journal.jumps()] == [
            (epoch, sequence, 10 * sequence) for sequence in range(4)
        ]


def test_what_is_published_is_the_jump(path: Path) -> None:
    (published,) = fill(path, 1)

    found = decode(Jump, published)

    assert (found.sequence, found.tick, found.increments.tolist()) == (0, 0, [0.0])


def test_two_journals_have_different_epochs_and_none_has_epoch_0(tmp_path: Path) -> None:
    with Journal(tmp_path / "one") as one, Journal(tmp_path / "other") as other:
        assert len({0, one.epoch, other.epoch}) == 3


def test_a_range_is_cut_to_what_there_is(path: Path) -> None:
    published = fill(path, 3)
    with Journal(path) as journal:
        assert list(journal.encoded(1, 3)) == published[1:]
        assert list(journal.encoded(-5, 99)) == published
        assert journal.encoded(2, 1) == ()
        assert journal.encoded(7, 9) == ()


def test_a_record_torn_at_any_byte_loses_itself_alone(path: Path) -> None:
    published = fill(path, 2)
    two = path.stat().st_size
    with Journal(path) as journal:
        epoch = journal.epoch
        third = journal.append(jump(epoch, 2))
    whole = path.read_bytes()

    for size in range(two, len(whole)):
        path.write_bytes(whole[:size])
        with Journal(path) as journal:
            assert journal.epoch == epoch
            assert list(journal.encoded(0, 9)) == published
            assert journal.append(jump(epoch, 2)) == third, "it goes on where it was cut"
        assert path.read_bytes() == whole


def test_a_header_torn_at_any_byte_is_made_anew(path: Path) -> None:
    fill(path, 0)
    whole = path.read_bytes()

    for size in range(len(whole)):
        path.write_bytes(whole[:size])
        fill(path, 1)
        assert len(reopen(path)) == 1


@pytest.mark.parametrize("length", [1, TORN_WITHIN_A_HEAD, 12, 4096])
def test_room_that_was_made_for_bytes_that_never_came_is_cut_off(path: Path, length: int) -> None:
    published = fill(path, 2)
    with path.open("ab") as file:
        file.write(bytes(length))

    assert list(reopen(path)) == published


def test_a_last_record_whose_bytes_did_not_all_come_is_cut_off(path: Path) -> None:
    published = fill(path, 3)
    damaged = bytearray(path.read_bytes())
    damaged[-1] ^= 0xFF
    path.write_bytes(damaged)

    assert list(reopen(path)) == published[:2]


def test_a_flipped_bit_anywhere_is_an_error_or_costs_the_last_record_alone(path: Path) -> None:
    """A jump that is silently cut off would have its number used again: the drones would differ for good."""
    published = fill(path, 3)
    whole = path.read_bytes()
    errors = 0

    for bit in range(8 * len(whole)):
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        try:
            found = list(reopen(path))
        except JournalError:
            errors += 1
            assert path.read_bytes() == damaged, "what cannot be read is left as it is"
        else:
            assert found == published[:2]
    assert errors > 4 * len(whole)


@pytest.mark.parametrize("content", [b"hello", b"\x00", b"covrecon-journal-2\n" + bytes(64), b"#!/bin/sh\nexit\n" * 9])
def test_a_file_that_is_no_journal_is_refused_and_left_alone(path: Path, content: bytes) -> None:
    path.write_bytes(content)

    with pytest.raises(JournalError, match="journal: is not a journal"):
        Journal(path)
    assert path.read_bytes() == content


def test_a_folder_and_a_missing_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(JournalError, match="Is a directory"):
        Journal(tmp_path)
    with pytest.raises(JournalError, match="No such file"):
        Journal(tmp_path / "nowhere" / "journal")


def test_records_of_another_journal_are_refused(tmp_path: Path) -> None:
    fill(tmp_path / "one", 1)
    fill(tmp_path / "other", 0)
    header, alien = (tmp_path / "other").read_bytes(), (tmp_path / "one").read_bytes()
    mixed = tmp_path / "mixed"
    mixed.write_bytes(header + alien[len(header) :])

    with pytest.raises(JournalError, match=r"holds jump 0 of epoch .* where jump 0 of .* belongs"):
        Journal(mixed)


@pytest.mark.parametrize(("epoch_off", "sequence"), [(0, 0), (0, 2), (1, 1)])
def test_a_jump_that_is_not_the_next_of_this_journal_is_refused(path: Path, epoch_off: int, sequence: int) -> None:
    published = fill(path, 1)
    with Journal(path) as journal:
        with pytest.raises(JournalError, match="is not the next of this journal: 1 of"):
            journal.append(jump(journal.epoch + epoch_off, sequence))
        published.append(journal.append(jump(journal.epoch, 1)))

    assert list(reopen(path)) == published


class FullDisk:
    """A file on a disk that takes ``room`` more bytes."""

    def __init__(self, file: object, room: int) -> None:
        self._file, self._room = file, room

    def write(self, content: memoryview) -> int:
        if self._room == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        written: int = self._file.write(content[: self._room])  # type: ignore[attr-defined]
        self._room -= written
        return written

    def __getattr__(self, name: str) -> object:
        return getattr(self._file, name)


@pytest.mark.parametrize("room", [0, 1, TORN_WITHIN_A_HEAD, 12, 60])
def test_a_full_disk_refuses_the_jump_and_leaves_the_journal_usable(path: Path, room: int) -> None:
    published = fill(path, 2)
    with Journal(path) as journal:
        disk = journal._file
        journal._file = FullDisk(disk, room)  # type: ignore[assignment]
        for _ in range(2):
            with pytest.raises(JournalError, match="No space left on device"):
                journal.append(jump(journal.epoch, 2))
        assert journal.next_sequence == 2
        assert list(journal.encoded(0, 9)) == published

        journal._file = disk
        published.append(journal.append(jump(journal.epoch, 2)))

    assert list(reopen(path)) == published


def test_a_jump_that_a_full_disk_refused_is_not_there_after_reopening(path: Path) -> None:
    published = fill(path, 2)
    with Journal(path) as journal:
        disk = journal._file
        journal._file = FullDisk(disk, 60)  # type: ignore[assignment]
        with pytest.raises(JournalError):
            journal.append(jump(journal.epoch, 2))
        journal._file = disk

    assert list(reopen(path)) == published


def test_a_disk_that_writes_piecemeal_gets_every_byte(path: Path) -> None:
    class Piecemeal(FullDisk):
        def write(self, content: memoryview) -> int:
            return super().write(content[:7])

    with Journal(path) as journal:
        disk = journal._file
        journal._file = Piecemeal(disk, 10**6)  # type: ignore[assignment]
        published = [journal.append(jump(journal.epoch, sequence)) for sequence in range(3)]
        journal._file = disk

    assert list(reopen(path)) == published


def test_a_jump_is_on_disk_before_it_may_be_published(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[bytes] = []
    with Journal(path) as journal:
        monkeypatch.setattr(os, "fdatasync", lambda _: synced.append(path.read_bytes()))

        published = journal.append(jump(journal.epoch, 0))

    assert [content.endswith(published) for content in synced] == [True]


def test_a_disk_that_does_not_sync_refuses_the_jump(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    with Journal(path) as journal:
        with monkeypatch.context() as broken:
            broken.setattr(os, "fdatasync", fail)
            with pytest.raises(JournalError, match="Input/output error"):
                journal.append(jump(journal.epoch, 0))
        published = journal.append(jump(journal.epoch, 0))

    assert reopen(path) == (published,)


def test_a_process_killed_between_append_and_publish_loses_nothing(path: Path) -> None:
    program = """
import os, signal, sys
from pathlib import Path
import numpy as np
from ground_station.journal import Journal
from protocol.messages import Jump
journal = Journal(Path(sys.argv[1]))
for sequence in range(3):
    increments = np.full(2, sequence, np.float32)
    journal.append(Jump(epoch=journal.epoch, sequence=sequence, tick=sequence, increments=increments))
os.kill(os.getpid(), signal.SIGKILL)
"""
    killed = subprocess.run(
        [sys.executable, "-c", program, str(path)], cwd=ROOT, check=False, capture_output=True, timeout=60
    )

    assert killed.returncode == -signal.SIGKILL, killed.stderr.decode()
    with Journal(path) as journal:
        assert [each.increments.tolist() for each in journal.jumps()] == [[0, 0], [1, 1], [2, 2]]
