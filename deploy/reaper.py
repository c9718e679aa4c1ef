"""Ends a run's processes when the launcher closes its pipe, or dies in whatever way: nothing outlives a run.

Run as a script by `deploy.local`, with the standard library alone. The reaper leads a process group, in which the
launcher starts every process. The kernel closes the launcher's end of the pipe even after ``kill -9``; then the group
gets SIGTERM, time to end itself, and SIGKILL. The group, not a list of ids, says who belongs to the run, so that a
process started a moment before the end, or started by another one, is found as well.
"""

from __future__ import annotations

import os
import shutil
import signal
import sys
import time
from pathlib import Path

POLL_S = 0.02


def main(grace_s: float, folder: Path) -> None:
    """Wait for the end of standard input, then end the own group within ``grace_s`` and remove ``folder``."""
    for ignored in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(ignored, signal.SIG_IGN)
    sys.stdin.buffer.read()
    if _others_in_group():
        os.killpg(0, signal.SIGTERM)
    deadline = time.monotonic() + grace_s
    while _others_in_group() and time.monotonic() < deadline:
        time.sleep(POLL_S)
    shutil.rmtree(folder, ignore_errors=True)
    if _others_in_group():
        os.killpg(0, signal.SIGKILL)  # and this process with them


def _others_in_group() -> bool:
    """Whether the group holds any living process but this one; Linux only."""
    own = os.getpid()
    return any(
        int(entry.name) != own and _group_if_alive(entry) == own
        for entry in Path("/proc").iterdir()
        if entry.name.isdigit()
    )


def _group_if_alive(process: Path) -> int | None:
    try:
        # "pid (name) state parent group ..."; the name may hold anything, parentheses too.
        state, _, group = (process / "stat").read_bytes().rpartition(b") ")[2].split()[:3]
    except (OSError, ValueError):  # it ended while being looked at
        return None
    return None if state in (b"Z", b"X") else int(group)


if __name__ == "__main__":
    main(float(sys.argv[1]), Path(sys.argv[2]))
