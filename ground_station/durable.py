"""What it takes that files survive a crash: drafts that replace, folders that are synced, nothing ever thrown away."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable
from pathlib import Path

from protocol.errors import StorageError

log = logging.getLogger(__name__)


def replace_file(path: Path, parts: Iterable[bytes | memoryview], *, keep_as: Path | None = None) -> None:
    """Put ``parts`` one after the other in ``path``: whoever looks, also after a power cut, sees the old or the new.

    The old file is renamed to ``keep_as`` if given; between the two renames there is that one alone. Raises OSError;
    then the old file is still there, under either name.
    """
    draft = draft_of(path)
    try:
        with draft.open("wb") as file:
            for part in parts:
                file.write(part)
            file.flush()
            os.fsync(file.fileno())
        if keep_as is not None and path.exists():
            path.replace(keep_as)
        draft.replace(path)
    except OSError:
        draft.unlink(missing_ok=True)  # a full disk needs the room
        raise
    sync_folder(path.parent)


def draft_of(path: Path) -> Path:
    return path.with_name(f".{path.name}.draft")


def sync_folder(folder: Path) -> None:
    """Put the folder's entries on disk too: a file without a name is lost. Raises OSError."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def set_aside(path: Path) -> Path:
    """Rename a damaged file, for people to look at; its new name. Raises OSError."""
    number = 1
    while (aside := path.with_name(f"{path.name}.damaged-{number}")).exists():
        number += 1
    path.rename(aside)
    sync_folder(path.parent)
    return aside


class DiskFaults:
    """Counts what the disk refused, and says so once in a row: a full disk must not fill the log as well."""

    def __init__(self, what: str) -> None:
        self._what = what
        self._in_a_row = 0
        self.count = 0

    def refused(self, error: OSError | StorageError) -> None:
        self.count += 1
        self._in_a_row += 1
        if self._in_a_row == 1:
            log.error("%s: the disk refuses it: %s; the flight goes on", self._what, getattr(error, "strerror", error))

    def took(self) -> None:
        if self._in_a_row:
            log.warning("%s: the disk takes it again, after %d refusals", self._what, self._in_a_row)
            self._in_a_row = 0
