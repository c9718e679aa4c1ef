"""What only one process of a machine may have: a port, and a MAVLink system.

MAVSDK binds UDP ports with SO_REUSEADDR: a second process would bind the same one without an error and take all its
packets. And two vehicles with one system id, on whatever ports, would be taken for one. A lock file in the system's
folder for temporary files is seen by all processes and users of the machine, and let go when its process ends, however
it ends.
"""

from __future__ import annotations

import fcntl
import os
import tempfile
from pathlib import Path

from protocol.errors import VehicleError

SHARED_MODE = 0o666
"""Any user may lock and sign; the file is never deleted, since a lock on a deleted file locks nothing."""
SIGNATURE_BYTES = 200


class MachineLock:
    """Held from construction to `release`."""

    def __init__(self, what: str, owner: str) -> None:
        """``what`` becomes part of a file's name; ``owner`` is told to whoever wants it too.

        Raises:
            VehicleError: another has it, or the file cannot be opened.
        """
        self._path = Path(tempfile.gettempdir()) / f"covrecon-{what.replace('/', '_').replace(':', '_')}.lock"
        try:
            self._file: int | None = _open(self._path)
        except OSError as error:
            raise VehicleError(f"{what}: cannot be locked: {error}") from error
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = os.pread(self._file, SIGNATURE_BYTES, 0).decode("utf-8", "replace").strip()
            os.close(self._file)
            self._file = None
            raise VehicleError(f"{what} is taken by {holder or 'another process'} ({self._path})") from error
        os.ftruncate(self._file, 0)
        os.pwrite(self._file, f"{owner}, process {os.getpid()}".encode()[:SIGNATURE_BYTES], 0)

    def release(self) -> None:
        """May be called again."""
        if self._file is not None:
            os.close(self._file)
            self._file = None


def _open(path: Path) -> int:
    """Created at most once, by whoever comes first; O_CREAT on another user's file in /tmp is refused by Linux."""
    flags = os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW
    try:
        return os.open(path, flags)
    except FileNotFoundError:
        try:
            made = os.open(path, flags | os.O_CREAT | os.O_EXCL, SHARED_MODE)
        except FileExistsError:
            return os.open(path, flags)
        os.fchmod(made, SHARED_MODE)  # the umask took some of it
        return made
