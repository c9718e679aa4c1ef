"""One flight of a study, flown by `covrecon run`'s machinery in a process of its own, and what is kept of it."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Final

from deploy.local import environment, process_group
from ground_station.evaluation import TRUTH_FILE
from ground_station.keyframe_log import KEYFRAMES_FILE
from ground_station.results import MESH_PLY_FILE, METRICS_FILE, MISSION_FILE, SUMMARY_FILE, TRAJECTORIES_FILE
from ground_station.study.plan_file import TRUTH_MESH_FILE
from protocol.errors import ProcessError

KEPT: Final = (MISSION_FILE, SUMMARY_FILE, METRICS_FILE, TRAJECTORIES_FILE, MESH_PLY_FILE, TRUTH_MESH_FILE)
"""Of a run's folder; the rest is large and can be made again."""
KEPT_TO_MAP: Final = (*KEPT, KEYFRAMES_FILE, TRUTH_FILE)
"""Of a flight whose map is made afterwards: some 40 MB."""
LOG_FILE: Final = "flight.log"
RUNS: Final = "runs"
POLL_S: Final = 0.2
"""How often it is looked whether the flight has ended."""
GRACE_S: Final = 15.0
"""What the flight's launcher gets to end its processes, which get `deploy.local.GRACE_S`, before it is killed."""
LOG_LINES: Final = 12
"""Last lines of a failed flight that are shown."""


async def fly_in(scratch: Path, mission_json: str, kept: Sequence[str] = KEPT) -> dict[str, bytes]:
    """Fly the mission in the empty folder ``scratch``; those of its files that are ``kept``, by name.

    Cancelled, or if this process dies in whatever way, it ends all that it started. Raises `ProcessError` if the flight
    fails.
    """
    mission, private = scratch / MISSION_FILE, scratch / "private"
    mission.write_text(mission_json)
    private.mkdir()
    # -P keeps the folder that the launcher was called in from shadowing a package.
    command = (sys.executable, "-P", "-m", "deploy.bench", str(mission), str(scratch / RUNS))
    code = await run_alone(command, private, scratch / LOG_FILE)
    if code != 0:
        raise ProcessError(f"ended with exit code {code}:\n    {_last_words(scratch / LOG_FILE)}")
    run = (scratch / RUNS / "latest").resolve()
    files = {name: (run / name).read_bytes() for name in kept if (run / name).exists()}
    return files | {LOG_FILE: (scratch / LOG_FILE).read_bytes()}


async def run_alone(command: Sequence[str], private: Path, log: Path) -> int:
    """Run ``command`` with all that it says in ``log``; its exit code.

    Cancelled, or if this process dies in whatever way, it ends all that the command started. ``private`` is an empty
    folder, which is removed then.
    """
    async with AsyncExitStack() as stack:
        group = await stack.enter_async_context(process_group(private, GRACE_S))
        with log.open("wb") as stream:
            # Not asyncio's: Ray's workers run uvloop, which knows no process groups.
            process = subprocess.Popen(  # noqa: ASYNC220  # a few milliseconds
                command,
                stdin=subprocess.DEVNULL,
                stdout=stream,
                stderr=subprocess.STDOUT,
                env=environment(os.environ),
                process_group=group,
            )
        try:
            while (code := process.poll()) is None:  # noqa: ASYNC110  # see above
                await asyncio.sleep(POLL_S)
        finally:
            await stack.aclose()  # ends it if it has not ended
            process.wait()
    return code


def flown_s(scratch: Path) -> float:
    """Mission time that the flight in ``scratch`` has flown by now, for people: 0 before its first second."""
    try:
        with (scratch / RUNS / "latest" / METRICS_FILE).open("rb") as file:
            last = file.read().splitlines()[-1]
        return float(last.partition(b",")[0])
    except (OSError, ValueError, IndexError):
        return 0.0


def keep(files: Mapping[str, bytes], folder: Path) -> None:
    """Write ``files`` as the new folder ``folder``, which is there only when it is whole. Raises OSError."""
    draft = folder.with_name(f".{folder.name}.draft")
    draft.mkdir(parents=True)
    for name, content in files.items():
        (draft / name).write_bytes(content)
    draft.rename(folder)


def _last_words(log: Path) -> str:
    return "\n    ".join(log.read_text(errors="replace").splitlines()[-LOG_LINES:])
