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
from hypothesis import given
from hypothesis import strategies as st

from faults.disk import FullDisk, dies, in_child
from ground_station.journal import JUMP_BYTES_MAX, Journal, open_journal, replace_journal
from protocol.errors import JournalDamaged, JournalError
from protocol.guard import ROOT
from protocol.messages import JournalPage, Jump
from protocol.wire import decode, encode

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
        return journal.page(0, journal.next_sequence)


def jumps(journal: Journal) -> list[Jump]:
    return [decode(Jump, encoded) for encoded in journal.page(0, journal.next_sequence)]


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
        assert list(journal.page(0, 4)) == published
        assert [(each.epoch, each.sequence, each.tick) for each in jumps(journal)] == [
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
        assert list(journal.page(1, 3)) == published[1:]
        assert list(journal.page(-5, 99)) == published
        assert journal.page(2, 1) == ()
        assert journal.page(7, 9) == ()


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
            assert list(journal.page(0, 9)) == published
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
        except JournalDamaged:
            errors += 1
            assert path.read_bytes() == damaged, "what cannot be read is left as it is"
        else:
            assert found == published[:2]
    assert errors > 4 * len(whole)


@pytest.mark.parametrize("content", [b"hello", b"\x00", bytes(64), b"#!/bin/sh\nexit\n" * 9])
def test_a_file_that_is_no_journal_is_refused_and_left_alone(path: Path, content: bytes) -> None:
    path.write_bytes(content)

    with pytest.raises(JournalDamaged, match="journal: is not a journal"):
        Journal(path)
    assert path.read_bytes() == content


def test_a_journal_of_the_version_before_is_refused_and_left_alone(path: Path) -> None:
    content = b"covrecon-journal-1\n" + bytes(8)
    path.write_bytes(content)

    with pytest.raises(JournalError, match="older version; take a new run folder"):
        open_journal(path)
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


@pytest.mark.parametrize("room", [0, 1, TORN_WITHIN_A_HEAD, 12, 60])
def test_a_full_disk_refuses_the_jump_and_leaves_the_journal_usable(path: Path, room: int) -> None:
    published = fill(path, 2)
    with Journal(path) as journal:
        disk = journal._file._file
        journal._file._file = FullDisk(disk, room)  # type: ignore[assignment]
        for _ in range(2):
            with pytest.raises(JournalError, match="No space left on device"):
                journal.append(jump(journal.epoch, 2))
        assert journal.next_sequence == 2
        assert list(journal.page(0, 9)) == published

        journal._file._file = disk
        published.append(journal.append(jump(journal.epoch, 2)))

    assert list(reopen(path)) == published


def test_a_jump_that_a_full_disk_refused_is_not_there_after_reopening(path: Path) -> None:
    published = fill(path, 2)
    with Journal(path) as journal:
        disk = journal._file._file
        journal._file._file = FullDisk(disk, 60)  # type: ignore[assignment]
        with pytest.raises(JournalError):
            journal.append(jump(journal.epoch, 2))
        journal._file._file = disk

    assert list(reopen(path)) == published


def test_a_jump_is_on_disk_before_it_may_be_published(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[bytes] = []
    with Journal(path) as journal:
        monkeypatch.setattr(os, "fdatasync", lambda _: synced.append(path.read_bytes()))

        published = journal.append(jump(journal.epoch, 0))

    assert [content.endswith(published) for content in synced] == [True]


def fail(*_: object) -> None:
    raise OSError(errno.EIO, os.strerror(errno.EIO))


def test_a_disk_that_does_not_sync_refuses_the_jump(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
        assert [each.increments.tolist() for each in jumps(journal)] == [[0, 0], [1, 1], [2, 2]]


# --- pages -----------------------------------------------------------------------------------------------------------


@given(limit=st.integers(0, 400), first=st.integers(-2, 12), last=st.integers(-2, 12))
def test_pages_one_after_the_other_hold_every_jump_once(
    tmp_path_factory: pytest.TempPathFactory, limit: int, first: int, last: int
) -> None:
    path = tmp_path_factory.getbasetemp() / "paged"
    if not path.exists():
        fill(path, 9)
    with Journal(path) as journal:
        wanted = [jump.sequence for jump in jumps(journal)][max(0, first) : max(0, last)]
        told: list[int] = []
        while page := journal.page(max(0, first) + len(told), last, limit):
            assert len(page) == 1 or sum(map(len, page)) <= limit
            told += [decode(Jump, encoded).sequence for encoded in page]
        assert told == wanted


def test_a_page_is_as_long_as_its_limit_allows(path: Path) -> None:
    published = fill(path, 4)
    with Journal(path) as journal:
        assert journal.page(0, 4, sum(map(len, published[:3]))) == tuple(published[:3])


def test_a_jump_that_no_reply_could_carry_is_refused(path: Path) -> None:
    with Journal(path) as journal:
        long = Jump(epoch=journal.epoch, sequence=0, tick=1, increments=np.zeros(JUMP_BYTES_MAX // 4, np.float32))
        with pytest.raises(JournalError, match="exceed the limit"):
            journal.append(long)
        most = JUMP_BYTES_MAX // 4 - 64
        longest = Jump(epoch=journal.epoch, sequence=0, tick=1, increments=np.zeros(most, np.float32))
        journal.append(longest)
        page = JournalPage(epoch=journal.epoch, first_sequence=0, next_sequence=1, jumps=journal.page(0, 1))
        assert decode(JournalPage, encode(page)).jumps == page.jumps


# --- compaction ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("below", [-1, 0, 1, 3, 4, 99])
def test_compaction_removes_the_jumps_below_a_number_and_no_other(path: Path, below: int) -> None:
    published = fill(path, 4)
    first = min(max(below, 0), 4)
    with Journal(path) as journal:
        epoch, size = journal.epoch, journal.size_bytes
        journal.compact(below)
        published.append(journal.append(jump(epoch, 4)))
        assert (journal.first_sequence, journal.next_sequence) == (first, 5)
        assert journal.size_bytes == path.stat().st_size
        assert (journal.size_bytes < size) == (first > 1)
        assert list(journal.page(0, 99)) == published[first:]

    with Journal(path) as journal:
        assert (journal.epoch, journal.first_sequence, journal.next_sequence) == (epoch, first, 5)
        assert list(journal.page(0, 99)) == published[first:]
        assert list(journal.page(4, 5)) == published[4:]


def test_a_crash_anywhere_in_a_compaction_leaves_the_old_journal_or_the_new(path: Path) -> None:
    published = fill(path, 4)
    whole = path.read_bytes()

    def compact() -> None:
        with Journal(path) as journal:
            journal.compact(3)
            journal.append(jump(journal.epoch, 4))

    outcomes, step = [], 0
    while True:
        path.write_bytes(whole)
        died = dies(compact, step)
        with Journal(path) as journal:
            first, last = journal.first_sequence, journal.next_sequence
            assert (first, last) in {(0, 4), (3, 4), (3, 5)}
            assert list(journal.page(first, 4)) == published[first:]
            journal.compact(first + 1)  # over the draft that the crash may have left
        outcomes.append((first, last))
        if not died:
            break
        step += 1
    assert outcomes[-1] == (3, 5)
    assert outcomes == sorted(outcomes)
    assert set(outcomes) == {(0, 4), (3, 4), (3, 5)}


@pytest.mark.parametrize("call", ["fdatasync", "replace"])
def test_a_compaction_that_the_disk_refuses_changes_nothing(
    path: Path, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    published = fill(path, 4)
    with Journal(path) as journal:
        with monkeypatch.context() as broken:
            broken.setattr(os, call, fail)
            with pytest.raises(JournalError, match="Input/output error"):
                journal.compact(3)
        assert [file.name for file in path.parent.iterdir()] == ["journal"]
        assert journal.first_sequence == 0
        published.append(journal.append(jump(journal.epoch, 4)))
    assert list(reopen(path)) == published


def test_after_a_compaction_whose_name_is_not_safe_a_jump_is_kept_only_once_it_is(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    published = fill(path, 4)
    with Journal(path) as journal:
        with monkeypatch.context() as broken:
            broken.setattr(os, "fsync", fail)
            with pytest.raises(JournalError, match="Input/output error"):
                journal.compact(3)
            with pytest.raises(JournalError, match="Input/output error"):
                journal.append(jump(journal.epoch, 4))
        published.append(journal.append(jump(journal.epoch, 4)))
        assert list(journal.page(0, 9)) == published[3:]
    assert list(reopen(path)) == published[3:]


# --- damage ----------------------------------------------------------------------------------------------------------


def damage(path: Path) -> bytes:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    return bytes(content)


def test_a_damaged_journal_is_set_aside_and_a_new_epoch_begins(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with Journal(path) as journal:
        epochs = {journal.epoch}
    for number in (1, 2):
        path.unlink()
        fill(path, 3)
        damaged = damage(path)
        with open_journal(path) as journal:
            assert journal.replaced == path.with_name(f"journal.damaged-{number}")
            assert journal.replaced.read_bytes() == damaged
            assert (journal.first_sequence, journal.next_sequence) == (0, 0)
            epochs.add(journal.epoch)
            journal.append(jump(journal.epoch, 0))
    assert len(epochs) == 3
    assert [entry.levelname for entry in caplog.records] == ["ERROR", "ERROR"]
    assert "it is now journal.damaged-1" in caplog.text
    with open_journal(path) as journal:
        assert journal.replaced is None
        assert journal.next_sequence == 1


def test_a_flipped_bit_anywhere_never_keeps_the_ground_station_from_starting(path: Path) -> None:
    published = fill(path, 2)
    whole = path.read_bytes()
    with Journal(path) as journal:
        epoch = journal.epoch

    for place in range(len(whole)):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << place % 8
        path.write_bytes(damaged)
        with open_journal(path) as journal:
            if journal.replaced is None:
                assert (journal.epoch, journal.page(0, 9)) == (epoch, (published[0],))
            else:
                assert journal.epoch != epoch
                journal.replaced.unlink()


def test_a_crash_while_a_journal_is_set_aside_loses_neither(path: Path) -> None:
    fill(path, 3)
    damaged = damage(path)
    step = 0
    while True:
        for file in path.parent.iterdir():
            file.unlink()
        path.write_bytes(damaged)
        died = dies(lambda: open_journal(path).close(), step)
        with open_journal(path) as journal:
            assert journal.next_sequence == 0
        assert path.with_name("journal.damaged-1").read_bytes() == damaged
        if not died:
            return
        step += 1


def test_a_journal_that_others_know_to_be_incomplete_can_be_replaced(path: Path) -> None:
    fill(path, 3)
    whole = path.read_bytes()
    journal = Journal(path)

    with replace_journal(journal, "the drones hold jumps up to 7") as new:
        assert new.epoch != journal.epoch
        assert new.replaced is not None
        assert new.replaced.read_bytes() == whole


# --- the real thing --------------------------------------------------------------------------------------------------


def test_a_file_that_may_not_grow_refuses_jumps_and_keeps_the_rest(path: Path) -> None:
    published = fill(path, 2)

    def append() -> None:
        with Journal(path) as journal:
            for _ in range(2):
                with pytest.raises(JournalError, match="File too large"):
                    journal.append(jump(journal.epoch, 2))

    assert in_child(append, largest_file=path.stat().st_size + 50) == 0
    assert list(reopen(path)) == published
