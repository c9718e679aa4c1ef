"""Makes a recording that was cut short whole again: all chunks that can be read, with the index that players need."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.writer import Writer

from ground_station.durable import draft_of, sync_folder
from ground_station.recording.file import CHUNK_BYTES
from ground_station.recording.mcap_file import Content, Salvage, is_mcap
from protocol.errors import RecordingError


@dataclass(frozen=True, slots=True)
class Repaired:
    messages: int
    """That were recovered."""
    lost_bytes: int
    """Of the source: torn or damaged."""
    size_bytes: int
    """Of the source."""
    duration_s: float
    """Mission time from the first message to the last."""


def repair(source: Path, target: Path) -> Repaired:
    """Write what can be read of ``source`` to the new file ``target``. A source that is whole is copied.

    Raises:
        RecordingError: the source is not an MCAP file or holds no message, the target exists, or the disk refuses it.
    """
    draft = draft_of(target)
    try:
        if not is_mcap(source):
            raise RecordingError(f"{source}: not an MCAP file")
        if target.exists():
            raise RecordingError(f"{target}: exists already")
        salvage = Salvage(source)
        try:
            with draft.open("wb") as file:
                count, duration_s = _copy(salvage.contents(), file)
                file.flush()
                os.fsync(file.fileno())
            if not count:
                raise RecordingError(f"{source}: holds nothing that can be recovered")
            draft.replace(target)
        finally:
            draft.unlink(missing_ok=True)
        sync_folder(target.parent)
        return Repaired(count, salvage.lost_bytes, source.stat().st_size, duration_s)
    except OSError as error:
        raise RecordingError(f"{error.filename or target}: {error.strerror}") from error


def _copy(contents: Iterator[Content], file: IO[bytes]) -> tuple[int, float]:
    """Number of messages, and time that they span in s."""
    writer = Writer(file, chunk_size=CHUNK_BYTES)
    writer.start()
    schemas: dict[int, int] = {0: 0}
    channels: dict[int, int] = {}
    count, first_ns, last_ns = 0, None, 0
    for content in contents:
        match content:
            case Schema() if content.id not in schemas:
                schemas[content.id] = writer.register_schema(content.name, content.encoding, content.data)
            case Channel() if content.id not in channels:
                channels[content.id] = writer.register_channel(
                    content.topic, content.message_encoding, schemas.get(content.schema_id, 0), content.metadata
                )
            case Message() if content.channel_id in channels:
                writer.add_message(
                    channels[content.channel_id],
                    content.log_time,
                    content.data,
                    content.publish_time,
                    content.sequence,
                )
                count += 1
                first_ns = content.log_time if first_ns is None else min(first_ns, content.log_time)
                last_ns = max(last_ns, content.log_time)
            case Metadata():
                writer.add_metadata(content.name, content.metadata)
            case Attachment():
                writer.add_attachment(
                    content.create_time, content.log_time, content.name, content.media_type, content.data
                )
    writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves it so
    return count, (last_ns - first_ns) / 1e9 if first_ns is not None else 0.0
