"""Files of the authority: one run at a time writes them, and whoever reads them sees the old or the new."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from protocol.certificates import open_to_others
from protocol.errors import CredentialsError

PRIVATE, PUBLIC = 0o600, 0o644
"""Modes of keys, and of all that may be shown; the folder keeps others out of both."""
FOLDER = 0o700


def make_folder(folder: Path) -> None:
    """A folder that only its owner may enter; one that is there and empty is taken.

    Raises:
        CredentialsError: it cannot be made, or others could read what will be in it.
    """
    with told():
        folder.mkdir(mode=FOLDER, parents=True, exist_ok=True)
        if not any(folder.iterdir()):
            folder.chmod(FOLDER)
        if open_to_others(folder):
            raise CredentialsError(f"{folder}: others than its owner may enter it; run: chmod 700 {folder}")


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Wait until no other run is at work in ``folder``, and keep others out; errors of the disk as `CredentialsError`.

    The folder itself is locked: there is no file that could be left over, or copied with the others.
    """
    with told():
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            yield
        finally:
            os.close(descriptor)


def write(path: Path, content: bytes, mode: int) -> None:
    """Put ``content`` on disk under ``path``, never readable by more than ``mode`` allows. Raises OSError."""
    draft = path.with_name(f".{path.name}.draft")
    draft.unlink(missing_ok=True)  # of a run that was killed
    try:
        descriptor = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, mode)
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
    except OSError:
        draft.unlink(missing_ok=True)
        raise
    _sync_folder(path.parent)


def _sync_folder(folder: Path) -> None:
    """A new name is lost with the power until its folder is on disk too."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def told() -> Iterator[None]:
    """The disk's errors as `CredentialsError`."""
    try:
        yield
    except OSError as error:
        raise CredentialsError(f"{error.filename or 'the disk'}: {error.strerror or error}") from error
