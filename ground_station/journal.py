"""Write-ahead journal of the jumps: on disk before anybody hears of them (safety rule 5).

The file is a header with the epoch, then records of ``length, crc32, bytes``. A record that was torn by a crash is cut
off when the journal is opened again: nobody can have heard of it.
"""

from __future__ import annotations

import os
import secrets
import struct
import zlib
from pathlib import Path
from typing import BinaryIO, Self

from protocol.errors import JournalError
from protocol.messages import Jump
from protocol.wire import decode, encode

MAGIC = b"covrecon-journal-1\n"
_EPOCH = struct.Struct("<Q")
_RECORD = struct.Struct("<II")


class Journal:
    """All jumps of one mission, in memory encoded and on disk; ``epoch`` tells this journal from any other."""

    def __init__(self, path: Path) -> None:
        """Open or create.

        Raises:
            JournalError: it cannot be written, or is not a journal.
        """
        self._path = path
        try:
            self._file: BinaryIO = path.open("r+b" if path.exists() else "x+b")
            self.epoch, self._jumps = self._read()
        except OSError as error:
            raise JournalError(f"{path}: {error.strerror}") from error

    def _read(self) -> tuple[int, list[bytes]]:
        header = self._file.read(len(MAGIC) + _EPOCH.size)
        if not header:
            epoch = secrets.randbits(62) + 1
            self._write(MAGIC + _EPOCH.pack(epoch))
            return epoch, []
        if not header.startswith(MAGIC) or len(header) < len(MAGIC) + _EPOCH.size:
            raise JournalError(f"{self._path}: is not a journal")
        jumps = []
        end = self._file.tell()
        while len(head := self._file.read(_RECORD.size)) == _RECORD.size:
            length, checksum = _RECORD.unpack(head)
            content = self._file.read(length)
            if len(content) < length or zlib.crc32(content) != checksum:
                break
            jumps.append(content)
            end = self._file.tell()
        self._file.seek(end)
        self._file.truncate()
        return _EPOCH.unpack_from(header, len(MAGIC))[0], jumps

    def _write(self, content: bytes) -> None:
        self._file.write(content)
        self._file.flush()
        os.fdatasync(self._file.fileno())

    @property
    def next_sequence(self) -> int:
        return len(self._jumps)

    def append(self, jump: Jump) -> bytes:
        """Keep ``jump`` on disk; only then may the returned bytes be published.

        Raises:
            JournalError: it is not the next of this epoch, or the disk refused it; it must not be published.
        """
        if (jump.epoch, jump.sequence) != (self.epoch, self.next_sequence):
            raise JournalError(
                f"jump {jump.sequence} of epoch {jump.epoch} is not the next of this journal:"
                f" {self.next_sequence} of {self.epoch}"
            )
        encoded = encode(jump)
        start = self._file.tell()
        try:
            self._write(_RECORD.pack(len(encoded), zlib.crc32(encoded)) + encoded)
        except OSError as error:
            self._file.seek(start)
            raise JournalError(f"{self._path}: {error.strerror}") from error
        self._jumps.append(encoded)
        return encoded

    def encoded(self, first: int, last: int) -> tuple[bytes, ...]:
        """Jumps ``first`` to ``last`` - 1 as they were published; fewer if there are fewer."""
        return tuple(self._jumps[max(0, first) : max(0, last)])

    def jumps(self) -> list[Jump]:
        return [decode(Jump, encoded) for encoded in self._jumps]

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
