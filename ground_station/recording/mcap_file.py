"""MCAP files, whole or torn: their records in the order of the file, and what of a damaged one can still be read."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Final, TypeAlias

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import breakup_chunk

MAGIC: Final = b"\x89MCAP0\r\n"
CHUNK_BYTES_MAX: Final = 2**30
"""More is a length that was damaged; ours have what one map takes, some megabytes."""
_HEAD: Final = struct.Struct("<BQ")
"""Before each record: what it is, and its length."""

Content: TypeAlias = Schema | Channel | Message | Metadata | Attachment

DAMAGE: Final = (McapError, ValueError, struct.error, zstandard.ZstdError)
"""What reading a damaged file raises; failed checksums and undecodable text are ValueErrors."""


def is_mcap(path: Path) -> bool:
    """Raises OSError."""
    with path.open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC


def is_whole(path: Path) -> bool:
    """Whether its writer came to its end. Raises OSError."""
    with path.open("rb") as file:
        size = file.seek(0, 2)
        file.seek(max(0, size - len(MAGIC)))
        return size > 2 * len(MAGIC) and file.read() == MAGIC


class Salvage:
    """Reads all that is whole in a file: every chunk whose checksum fits, up to where the file ends or its records
    make no sense any more."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.lost_bytes = 0
        """Of what was read so far: damaged, or torn."""

    def contents(self) -> Iterator[Content]:
        """What the file holds, but for its indices. Raises OSError."""
        self.lost_bytes = 0
        size = self._path.stat().st_size
        with self._path.open("rb") as file:
            place = file.seek(len(MAGIC))
            while place < size:
                head = file.read(_HEAD.size)
                kind, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (0, size)
                following = place + _HEAD.size + length
                if kind == 0 or following > size:
                    self.lost_bytes += size - place
                    return
                if kind == Opcode.DATA_END:
                    return
                try:
                    yield from _contents_of(kind, file.read(length))
                except DAMAGE:
                    self.lost_bytes += following - place
                place = file.seek(following)


def _contents_of(kind: int, record: bytes) -> list[Content]:
    """What is in one record; nothing for indices and what this version of MCAP does not know."""
    stream = ReadDataStream(BytesIO(record))
    match kind:
        case Opcode.CHUNK:
            chunk = Chunk.read(stream)
            if chunk.uncompressed_size > CHUNK_BYTES_MAX:
                raise ValueError(f"a chunk of {chunk.uncompressed_size} bytes")
            found = breakup_chunk(chunk, validate_crc=True)
            return [content for content in found if isinstance(content, Schema | Channel | Message)]
        case Opcode.SCHEMA:
            return [Schema.read(stream)]
        case Opcode.CHANNEL:
            return [Channel.read(stream)]
        case Opcode.MESSAGE:
            return [Message.read(stream, len(record))]
        case Opcode.METADATA:
            return [Metadata.read(stream)]
        case Opcode.ATTACHMENT:
            return [Attachment.read(stream)]
    return []
