"""All keyframes of a flight on disk: the map can be made again from them, after a crash or with another method.

One record (`ground_station.record_file`) for each, as it travelled. Keyframes are not synced: a killed process loses
none, a power cut the newest. And a disk that refuses them does not stop the flight.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol, Self

from ground_station.durable import DiskFaults
from ground_station.record_file import HEAD_BYTES, GrowingFile, lay_out, record
from protocol.errors import MessageError, StorageError
from protocol.messages import Keyframe
from protocol.wire import decode, encode

log = logging.getLogger(__name__)

KEYFRAMES_FILE = "keyframes"


class KeyframeStore(Protocol):
    """What the map needs of the place where its keyframes are kept; see `KeyframeLog`."""

    @property
    def count(self) -> int: ...
    @property
    def end(self) -> int: ...
    def append(self, keyframe: Keyframe) -> None: ...
    def sync(self) -> None: ...
    def read(self, first: int, last: int) -> Iterator[tuple[int, Keyframe]]: ...


class NoKeyframes:
    """Keeps none: of a map that is made from what is kept already."""

    count = end = 0

    def append(self, keyframe: Keyframe) -> None:
        """Nothing is to be done."""

    def sync(self) -> None:
        """Nothing is to be done."""

    def read(self, first: int, last: int) -> Iterator[tuple[int, Keyframe]]:  # noqa: ARG002  # the protocol's
        return iter(())


class KeyframeLog:
    """Positions in it are bytes from its start. Used by one thread at a time."""

    def __init__(self, path: Path) -> None:
        """Open or create; the end that a crash tore is written over, and damage is told and left where it is.

        Raises:
            StorageError: it cannot be opened.
        """
        self._path = path
        self._faults = DiskFaults(str(path))
        try:
            self._file = GrowingFile(path)
        except OSError as error:
            raise StorageError(f"{path}: {error.strerror}") from error
        with self._file.contents() as data:
            layout = lay_out(data)
        self._file.end = layout.end
        self.count = len(layout.contents)
        """Keyframes that it holds."""
        for damaged in layout.damaged:
            log.error("%s: damaged from byte %d to %d: keyframes are lost", path, damaged.first, damaged.last)

    @property
    def end(self) -> int:
        """Where the next keyframe goes."""
        return self._file.end

    @property
    def lost_records(self) -> int:
        """Keyframes that the disk refused; the map has them all the same."""
        return self._faults.count

    def append(self, keyframe: Keyframe) -> None:
        try:
            self._file.append(record(encode(keyframe)))
        except OSError as error:
            self._faults.refused(error)
        else:
            self.count += 1
            self._faults.took()

    def sync(self) -> None:
        """Put on disk what is appended: before something else on disk speaks of its positions.

        Raises:
            StorageError: the disk refuses it.
        """
        try:
            self._file.sync()
        except OSError as error:
            raise StorageError(f"{self._path}: {error.strerror}") from error

    def read(self, first: int, last: int) -> Iterator[tuple[int, Keyframe]]:
        """The keyframes from position ``first`` to before ``last``, each with its own position; damaged ones are
        left out. Nothing may be appended meanwhile."""
        with self._file.contents() as data:
            for content in lay_out(data, first).contents:
                position = content.first - HEAD_BYTES
                if position >= last:
                    return
                try:
                    yield position, decode(Keyframe, data[content.first : content.last])
                except MessageError as error:
                    log.warning("%s: keyframe at byte %d is left out: %s", self._path, position, error)

    def page(self, first: int, last: int, limit_bytes: int) -> tuple[list[bytes], int]:
        """Keyframes as they travelled, from position ``first`` to before ``last``, at least one if there is any, more
        of them up to ``limit_bytes``; and the position behind them. From any thread, also while others append.

        Raises:
            StorageError: the disk refuses it.
        """
        while True:
            size = min(limit_bytes, last - first)
            try:
                data = self._file.read_at(first, size)
            except OSError as error:
                raise StorageError(f"{self._path}: {error.strerror}") from error
            layout = lay_out(data)
            if layout.contents or size == last - first:
                whole = [data[content.first : content.last] for content in layout.contents]
                return whole, first + layout.end if whole else last
            limit_bytes *= 2

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
