"""Disks that are full, and processes that die between any two system calls."""

from __future__ import annotations

import errno
import os
import resource
import sys
import traceback
from collections.abc import Callable
from io import FileIO
from pathlib import Path
from typing import Any

from ground_station import record_file

DIED = 77
"""Exit code of a child that died as it should."""
_CALLS = ("fsync", "fdatasync", "replace", "rename", "unlink")


class FullDisk:
    """A file on a disk that takes ``room`` more bytes, no more than ``piece`` at once."""

    def __init__(self, file: object, room: int, piece: int = 2**30) -> None:
        self._file, self._room, self._piece = file, room, piece

    def write(self, content: memoryview) -> int:
        if self._room == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        written: int = self._file.write(content[: min(self._room, self._piece)])  # type: ignore[attr-defined]
        self._room -= written
        return written

    def __getattr__(self, name: str) -> object:
        return getattr(self._file, name)


def in_child(action: Callable[[], object], largest_file: int | None = None) -> int:
    """Exit code of a child process that does ``action``; no file may grow beyond ``largest_file`` bytes in it."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    code = 0
    try:
        if largest_file is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file, largest_file))
        action()
    except BaseException:  # noqa: BLE001  # a child must not go on with the parent's tests
        traceback.print_exc(file=sys.stderr)
        code = 1
    finally:
        os._exit(code)


def dies(action: Callable[[], object], step: int) -> bool:
    """Do ``action`` in a child that dies at its system call ``step``; False if it was done before.

    Counted are writes, of which every second half is a call of its own, and what puts names and bytes on disk.
    """
    left = step

    def count() -> None:
        nonlocal left
        left -= 1
        if left < 0:
            os._exit(DIED)

    class Mortal(FileIO):
        def write(self, content: Any) -> int:
            count()
            data = memoryview(content)
            written = super().write(data[: (len(data) + 1) // 2])
            count()
            return written

    def counted(call: Callable[..., Any]) -> Callable[..., Any]:
        def wrapped(*arguments: Any, **options: Any) -> Any:
            count()
            return call(*arguments, **options)

        return wrapped

    original = Path.open

    def mortal_open(path: Path, mode: str = "r", *options: Any, **named: Any) -> Any:
        return original(path, mode, *options, **named) if "r" in mode else _Whole(Mortal(path, mode.strip("b")))

    def run() -> None:
        for name in _CALLS:
            setattr(os, name, counted(getattr(os, name)))
        record_file.FileIO = Mortal  # type: ignore[misc]
        Path.open = mortal_open  # type: ignore[method-assign,assignment]
        action()

    code = in_child(run)
    if code not in (0, DIED):
        raise AssertionError("the child failed; its traceback is on stderr")
    return code == DIED


class _Whole:
    """Unbuffered file whose write takes everything, as a buffered one's does."""

    def __init__(self, file: FileIO) -> None:
        self._file = file

    def write(self, content: bytes) -> None:
        rest = memoryview(content)
        while rest:
            rest = rest[self._file.write(rest) :]

    def flush(self) -> None:
        """Nothing waits."""

    def fileno(self) -> int:
        return self._file.fileno()

    def __enter__(self) -> _Whole:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
