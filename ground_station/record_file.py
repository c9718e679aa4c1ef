"""Files that only grow: a record is there whole or not at all, and damage never passes for data.

A record is a head (mark, length, CRC-32 of the content, CRC-32 of the head so far) and its content. A crash can tear
only the end of a file; the next writer cuts that off. All else that does not check is damage. It is told and reaches
to the next record that checks, which the mark helps to find.
"""

from __future__ import annotations

import mmap
import os
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from typing import TypeAlias

Data: TypeAlias = bytes | mmap.mmap

MARK = b"\xf5rec"
_HEAD = struct.Struct("<4sQI")
_CHECK = struct.Struct("<I")
HEAD_BYTES = _HEAD.size + _CHECK.size


def head(content: bytes | memoryview) -> bytes:
    """What stands before ``content``, which must be bytes one by one (`memoryview.cast`), to make it a record."""
    described = _HEAD.pack(MARK, len(content), zlib.crc32(content))
    return described + _CHECK.pack(zlib.crc32(described))


def record(content: bytes) -> bytes:
    return head(content) + content


@dataclass(frozen=True, slots=True)
class Span:
    """Bytes ``first`` to ``last`` - 1 of a file."""

    first: int
    last: int


@dataclass(frozen=True, slots=True)
class Layout:
    """Where things are in a file."""

    contents: tuple[Span, ...]
    damaged: tuple[Span, ...]
    end: int
    """Where the next record belongs; what lies behind was torn by a crash."""


def lay_out(data: Data, start: int = 0) -> Layout:
    """Find the records from byte ``start`` on."""
    contents, damaged = [], []
    place = start
    while place < len(data):
        content = _content_at(data, place)
        if content is not None:
            contents.append(content)
            place = content.last
            continue
        following = _next_record(data, place)
        if following == len(data) and _is_torn(data, place):
            break
        damaged.append(Span(place, following))
        place = following
    return Layout(tuple(contents), tuple(damaged), place)


def _described_at(data: Data, place: int) -> tuple[Span, int] | None:
    """Content and its checksum, as a head at ``place`` tells; None without a head that checks."""
    if len(data) - place < HEAD_BYTES:
        return None
    mark, length, checksum = _HEAD.unpack_from(data, place)
    behind = place + _HEAD.size
    if mark != MARK or _CHECK.unpack_from(data, behind)[0] != _crc(data, Span(place, behind)):
        return None
    first = place + HEAD_BYTES
    return Span(first, first + length), checksum


def _content_at(data: Data, place: int) -> Span | None:
    """Content of the record at ``place``; None where there is none that checks."""
    described = _described_at(data, place)
    if described is None or described[0].last > len(data) or _crc(data, described[0]) != described[1]:
        return None
    return described[0]


def _next_record(data: Data, place: int) -> int:
    """Where the next record after ``place`` begins that checks; the file's length if none does."""
    while (place := data.find(MARK, place + 1)) >= 0:
        if _content_at(data, place) is not None:
            return place
    return len(data)


def _is_torn(data: Data, place: int) -> bool:
    """Whether a crash can have left what is at ``place``, behind which no record follows."""
    described = _described_at(data, place)
    if described is not None:
        return described[0].last >= len(data)
    # A file system may make room for bytes that then never come.
    with memoryview(data) as view:
        return not any(view[place + HEAD_BYTES - 1 :])


def _crc(data: Data, span: Span) -> int:
    with memoryview(data) as view:
        return zlib.crc32(view[span.first : span.last])


class GrowingFile:
    """What is appended comes behind what is known to be there, whatever a write that failed left behind.

    Constructor and methods raise OSError.
    """

    def __init__(self, path: Path) -> None:
        self._file = FileIO(path, "r+" if path.exists() else "x+")
        self.end = 0
        """Where the next append goes; the reader sets it."""

    @contextmanager
    def contents(self) -> Iterator[Data]:
        """All that the file holds, valid inside the block."""
        if os.fstat(self._file.fileno()).st_size == 0:
            yield b""
            return
        with mmap.mmap(self._file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            yield data

    def read_at(self, place: int, count: int) -> bytes:
        """From any thread."""
        return os.pread(self._file.fileno(), count, place)

    def append(self, content: bytes, *, synced: bool = False) -> None:
        """``synced``: return when it is on disk, not only with the operating system."""
        self._file.seek(self.end)
        self._file.truncate()
        rest = memoryview(content)
        while rest:
            rest = rest[self._file.write(rest) :]
        if synced:
            self.sync()
        self.end += len(content)

    def sync(self) -> None:
        os.fdatasync(self._file.fileno())

    def close(self) -> None:
        self._file.close()
