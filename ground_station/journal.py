"""Write-ahead journal of the jumps: on disk before anybody hears of them.

The file is a header with the epoch, then for each jump its length, two checksums and its bytes. A record that a crash
tore can only be the last; nobody can have heard of it, so it is cut off when the journal is opened again. Any other
damage would lose jumps that the drones have already taken in, and is an error.
"""

from __future__ import annotations

import os
import secrets
import struct
import zlib
from io import FileIO
from pathlib import Path
from typing import Self

from protocol.errors import JournalError, MessageError
from protocol.messages import Jump
from protocol.wire import decode, encode

MAGIC = b"covrecon-journal-1\n"
_EPOCH = struct.Struct("<Q")
_HEADER_BYTES = len(MAGIC) + _EPOCH.size
_CONTENT = struct.Struct("<II")  # length and CRC-32 of an encoded jump ...
_CHECK = struct.Struct("<I")  # ... and the CRC-32 of these two: without it a wrong length would hide what follows
_HEAD_BYTES = _CONTENT.size + _CHECK.size


def _record(content: bytes) -> bytes:
    head = _CONTENT.pack(len(content), zlib.crc32(content))
    return head + _CHECK.pack(zlib.crc32(head)) + content


class Journal:
    """All jumps of one mission, in memory encoded and on disk; ``epoch`` tells this journal from any other."""

    def __init__(self, path: Path) -> None:
        """Open or create.

        Raises:
            JournalError: it cannot be written, is not a journal, or is damaged.
        """
        self._path = path
        self._jumps: list[bytes] = []
        self._end = 0
        try:
            self._file = FileIO(path, "r+" if path.exists() else "x+")
        except OSError as error:
            raise JournalError(f"{path}: {error.strerror}") from error
        try:
            self.epoch = self._read()
        except OSError as error:
            self.close()
            raise JournalError(f"{path}: {error.strerror}") from error
        except JournalError:
            self.close()
            raise

    def _read(self) -> int:
        """Take in all whole records; the epoch."""
        data = self._file.readall()
        if not data.startswith(MAGIC[: len(data)]):
            raise JournalError(f"{self._path}: is not a journal")
        if len(data) < _HEADER_BYTES:  # new, or torn before it held anything
            epoch = secrets.randbits(62) + 1
            self._write(MAGIC + _EPOCH.pack(epoch))
            self._keep_name()
            return epoch
        (epoch,) = _EPOCH.unpack_from(data, len(MAGIC))
        self._end = _HEADER_BYTES
        while (content := self._record_at(data, self._end)) is not None:
            self._require_next(epoch, content)
            self._jumps.append(content)
            self._end += _HEAD_BYTES + len(content)
        self._file.truncate(self._end)
        return int(epoch)

    def _record_at(self, data: bytes, start: int) -> bytes | None:
        """Content of the record at ``start``; None where there is none, or a torn one."""
        rest = memoryview(data)[start:]
        if len(rest) < _HEAD_BYTES:
            return None
        length, checksum = _CONTENT.unpack_from(rest)
        if _CHECK.unpack_from(rest, _CONTENT.size)[0] != zlib.crc32(rest[: _CONTENT.size]):
            if any(rest):
                raise JournalError(f"{self._path}: damaged at byte {start}")
            return None  # room that a file system made for bytes that never came
        content = rest[_HEAD_BYTES : _HEAD_BYTES + length]
        if len(content) == length and zlib.crc32(content) == checksum:
            return bytes(content)
        if len(rest) > _HEAD_BYTES + length:
            raise JournalError(f"{self._path}: damaged at byte {start}, and more follows")
        return None

    def _require_next(self, epoch: int, content: bytes) -> None:
        try:
            jump = decode(Jump, content)
        except MessageError as error:
            raise JournalError(f"{self._path}: jump {len(self._jumps)}: {error}") from error
        if (jump.epoch, jump.sequence) != (epoch, len(self._jumps)):
            raise JournalError(
                f"{self._path}: holds jump {jump.sequence} of epoch {jump.epoch}"
                f" where jump {len(self._jumps)} of {epoch} belongs"
            )

    def _write(self, content: bytes) -> None:
        """Put ``content`` on disk behind what is known to be there, over whatever a write that failed left behind."""
        self._file.seek(self._end)
        self._file.truncate()
        rest = memoryview(content)
        while rest:
            rest = rest[self._file.write(rest) :]
        os.fdatasync(self._file.fileno())
        self._end += len(content)

    def _keep_name(self) -> None:
        """Put the folder's entry on disk too: a file without a name is lost."""
        folder = os.open(self._path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)

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
        try:
            self._write(_record(encoded))
        except OSError as error:
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
