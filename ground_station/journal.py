"""Write-ahead journal of the jumps: on disk before anybody hears of them.

The file is a header with the epoch and the first jump's number, then one record (`ground_station.record_file`) for each
jump. A record that a crash tore can only be the last; nobody can have heard of it, so the next one is written over it.
Any other damage would lose jumps that the drones have already taken in: such a journal is set aside, and a new epoch
begins, in which all take phi anew.
"""

from __future__ import annotations

import logging
import secrets
import struct
import zlib
from pathlib import Path
from typing import Self

from ground_station.durable import draft_of, set_aside, sync_folder
from ground_station.record_file import Data, GrowingFile, lay_out, record
from protocol.errors import JournalDamaged, JournalError, MessageError
from protocol.messages import Jump
from protocol.wire import MAX_MESSAGE_BYTES, decode, encode

log = logging.getLogger(__name__)

JOURNAL_FILE = "journal"
"""Its name in the run folder; one that was set aside begins with it."""
MAGIC = b"covrecon-journal-2\n"
_MAGIC_BEFORE = b"covrecon-journal-1\n"
_NUMBERS = struct.Struct("<QQ")  # epoch and first sequence ...
_CHECK = struct.Struct("<I")  # ... and the CRC-32 of all before
_HEADER_BYTES = len(MAGIC) + _NUMBERS.size + _CHECK.size

PAGE_BYTES = 30_000
"""Jumps of one reply, as `protocol.blocks.PAGE_BYTES`: what also a slow link delivers."""
JUMP_BYTES_MAX = MAX_MESSAGE_BYTES - 1024
"""Of an encoded jump: a reply with nothing else must still travel."""


def open_journal(path: Path) -> Journal:
    """Open or create; a damaged journal is set aside, and the new one's `Journal.replaced` tells where.

    Raises:
        JournalError: the disk refuses it, or it is another version's.
    """
    try:
        return Journal(path)
    except JournalDamaged as error:
        return _replacement(path, str(error))


def replace_journal(journal: Journal, why: str) -> Journal:
    """Set ``journal`` aside and start a new one: for what only others can know, as that jumps are missing at its end.

    Raises:
        JournalError: the disk refuses it.
    """
    journal.close()
    return _replacement(journal.path, why)


def _replacement(path: Path, why: str) -> Journal:
    try:
        aside = set_aside(path)
    except OSError as error:
        raise JournalError(f"{path}: {error.strerror}") from error
    log.error("%s; it is now %s, and a new journal with a new epoch begins", why, aside.name)
    journal = Journal(path)
    journal.replaced = aside
    return journal


class Journal:
    """The jumps of one epoch, in memory encoded and on disk; older ones may have been removed (`compact`)."""

    def __init__(self, path: Path) -> None:
        """Open or create.

        Raises:
            JournalDamaged: what it holds is not what was written.
            JournalError: it cannot be written, or is another version's.
        """
        self.path = path
        self.epoch = 0
        """Tells this journal from any other."""
        self.first_sequence = 0
        """Of the oldest jump that is still there."""
        self.replaced: Path | None = None
        """Where the damaged journal went that was here before."""
        self._jumps: list[bytes] = []
        self._named = True
        try:
            self._file = GrowingFile(path)
        except OSError as error:
            raise JournalError(f"{path}: {error.strerror}") from error
        try:
            with self._file.contents() as data:
                is_new = not self._read(data)
            if is_new:
                self.epoch = secrets.randbits(62) + 1
                self._named = False
                self._write(_header(self.epoch, 0))
        except OSError as error:
            self.close()
            raise JournalError(f"{path}: {error.strerror}") from error
        except JournalError:
            self.close()
            raise

    def _read(self, data: Data) -> bool:
        """Take in all whole records; False if there is nothing yet, or a header torn before anything followed."""
        if data[: len(_MAGIC_BEFORE)] == _MAGIC_BEFORE:
            raise JournalError(f"{self.path}: was written by an older version; take a new run folder")
        if not MAGIC.startswith(data[: len(MAGIC)]):
            raise JournalDamaged(f"{self.path}: is not a journal")
        if len(data) < _HEADER_BYTES:
            return False
        self.epoch, self.first_sequence = _NUMBERS.unpack_from(data, len(MAGIC))
        if data[:_HEADER_BYTES] != _header(self.epoch, self.first_sequence):
            raise JournalDamaged(f"{self.path}: damaged at byte {len(MAGIC)}")
        layout = lay_out(data, _HEADER_BYTES)
        if layout.damaged:
            raise JournalDamaged(f"{self.path}: damaged at byte {layout.damaged[0].first}")
        for span in layout.contents:
            content = data[span.first : span.last]
            self._require_next(content)
            self._jumps.append(content)
        self._file.end = layout.end
        return True

    def _require_next(self, content: bytes) -> None:
        try:
            jump = decode(Jump, content)
        except MessageError as error:
            raise JournalDamaged(f"{self.path}: jump {self.next_sequence}: {error}") from error
        if (jump.epoch, jump.sequence) != (self.epoch, self.next_sequence):
            raise JournalDamaged(
                f"{self.path}: holds jump {jump.sequence} of epoch {jump.epoch}"
                f" where jump {self.next_sequence} of {self.epoch} belongs"
            )

    def _write(self, content: bytes) -> None:
        self._file.append(content, synced=True)
        if not self._named:
            try:
                sync_folder(self.path.parent)
            except OSError:
                self._file.end -= len(content)  # in a file without a name it would not be safe
                raise
            self._named = True

    @property
    def next_sequence(self) -> int:
        return self.first_sequence + len(self._jumps)

    @property
    def size_bytes(self) -> int:
        return self._file.end

    def append(self, jump: Jump) -> bytes:
        """Keep ``jump`` on disk; only then may the returned bytes be published.

        Raises:
            JournalError: it is not the next of this epoch, or the disk refused it; it must not be published. The
                journal stays usable: the next append tries the same place again.
        """
        if (jump.epoch, jump.sequence) != (self.epoch, self.next_sequence):
            raise JournalError(
                f"jump {jump.sequence} of epoch {jump.epoch} is not the next of this journal:"
                f" {self.next_sequence} of {self.epoch}"
            )
        encoded = encode(jump)
        if len(encoded) > JUMP_BYTES_MAX:
            raise JournalError(f"jump {jump.sequence}: {len(encoded)} bytes exceed the limit of {JUMP_BYTES_MAX}")
        try:
            self._write(record(encoded))
        except OSError as error:
            raise JournalError(f"{self.path}: {error.strerror}") from error
        self._jumps.append(encoded)
        return encoded

    def page(self, first: int, last: int, limit_bytes: int = PAGE_BYTES) -> tuple[bytes, ...]:
        """Jumps ``first`` to ``last`` - 1 as they were published, as many as fit, at least one.

        It begins at `first_sequence` if that is later, and ends early if there are no more.
        """
        start = max(first - self.first_sequence, 0)
        stop = max(last - self.first_sequence, 0)
        taken: list[bytes] = []
        size = 0
        for encoded in self._jumps[start:stop]:
            size += len(encoded)
            if taken and size > limit_bytes:
                break
            taken.append(encoded)
        return tuple(taken)

    def compact(self, below: int) -> None:
        """Remove the jumps below that number. A crash leaves the old file or the new one, both whole.

        Raises:
            JournalError: the disk refused it; nothing that is not removed is lost, and the journal stays usable.
        """
        removed = min(below, self.next_sequence) - self.first_sequence
        if removed <= 0:
            return
        kept, first = self._jumps[removed:], self.first_sequence + removed
        draft = draft_of(self.path)
        try:
            draft.unlink(missing_ok=True)
            file = GrowingFile(draft)
        except OSError as error:
            raise JournalError(f"{draft}: {error.strerror}") from error
        try:
            file.append(_header(self.epoch, first) + b"".join(map(record, kept)), synced=True)
            draft.replace(self.path)
        except OSError as error:
            file.close()
            draft.unlink(missing_ok=True)
            raise JournalError(f"{draft}: {error.strerror}") from error
        self._file.close()
        self._file, self._jumps, self.first_sequence = file, kept, first
        self._named = False
        try:
            sync_folder(self.path.parent)
        except OSError as error:
            raise JournalError(f"{self.path.parent}: {error.strerror}") from error
        self._named = True

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _header(epoch: int, first_sequence: int) -> bytes:
    described = MAGIC + _NUMBERS.pack(epoch, first_sequence)
    return described + _CHECK.pack(zlib.crc32(described))
