"""Makes the maps that a study still lacks from its flights' keyframes, some at a time; each by a process of its own."""

from __future__ import annotations

import asyncio
import json
import shutil
import sys
import time
from collections import deque
from collections.abc import Sequence
from contextlib import AsyncExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from deploy.bench.campaign import alone, until_interrupted
from deploy.bench.flight import keep, run_alone
from deploy.bench.progress import Watch
from deploy.bench.rooms import MapJob
from ground_station.results import MESH_PLY_FILE
from ground_station.study.plan_file import FIGURES_FILE, FLIGHTS_FOLDER, MAPS_FOLDER
from protocol.errors import ProcessError, StorageError

REASON_CODES: Final = (1, 2)
"""Exit codes of a process that says why it cannot: what is no accident, and would come to the same again."""


def maps_left(folder: Path, jobs: Sequence[MapJob]) -> list[MapJob]:
    """Those that are not made yet, of flights that are flown."""
    return [
        job
        for job in jobs
        if (folder / FLIGHTS_FOLDER / job.planned.flight.folder).is_dir()
        and not (folder / MAPS_FOLDER / job.planned.folder).is_dir()
    ]


async def make_maps(folder: Path, jobs: Sequence[MapJob], slots: int, watch: Watch) -> int:
    """The exit code, as of `deploy.bench.campaign.until_interrupted`.

    A way that cannot make a map of these keyframes leaves its reason instead of figures, and is no failure.
    """
    return await until_interrupted(_Maps(folder, jobs, slots, watch).run(), "maps", watch)


class _Maps:
    def __init__(self, folder: Path, jobs: Sequence[MapJob], slots: int, watch: Watch) -> None:
        self._flights, self._maps = folder / FLIGHTS_FOLDER, folder / MAPS_FOLDER
        self._waiting, self._slots, self._watch = deque(jobs), slots, watch
        self._failed = 0

    async def run(self) -> int:
        """How many failed."""
        self._maps.mkdir(parents=True, exist_ok=True)
        async with AsyncExitStack() as stack:
            stack.enter_context(alone(self._maps))
            for draft in self._maps.glob(".*.draft"):
                shutil.rmtree(draft)
            async with asyncio.TaskGroup() as crew:
                for _ in range(min(self._slots, len(self._waiting))):
                    crew.create_task(self._make_in_turn())
        return self._failed

    async def _make_in_turn(self) -> None:
        while self._waiting:
            job = self._waiting.popleft()
            name, began_s = job.planned.name, time.monotonic()
            self._watch.began(name)
            try:
                files = await self._make(job)
            except ProcessError as error:
                self._failed += 1
                self._watch.ended(name, f"failed: {error}", well=False)
                continue
            try:
                keep(files, self._maps / job.planned.folder)
            except OSError as error:
                raise StorageError(f"{error.filename}: {error.strerror}") from error
            self._watch.ended(name, f"{_said(files)}, {time.monotonic() - began_s:.0f} s", well=True)

    async def _make(self, job: MapJob) -> dict[str, bytes]:
        with TemporaryDirectory(prefix="covrecon-map-", ignore_cleanup_errors=True) as place:
            scratch, log = Path(place), Path(place) / "log"
            mesh, figures, private = scratch / MESH_PLY_FILE, scratch / FIGURES_FILE, scratch / "private"
            private.mkdir()
            flight = (self._flights / job.planned.flight.folder).resolve()
            # -P keeps the current folder from shadowing a package.
            command = [sys.executable, "-P", "-m", "ground_station.rebuild", str(flight)]
            command += ["--quality", job.quality, "--backend", job.backend]
            command += ["--out", str(mesh), "--figures", str(figures)]
            command += [part for setting in (*job.settings, "reconstruction.workers=1") for part in ("--set", setting)]
            code = await run_alone(command, private, log)
            if code == 0:
                return {file.name: file.read_bytes() for file in (mesh, figures)}
            words = log.read_text(errors="replace").strip().splitlines() or [f"exit code {code}"]
            if code not in REASON_CODES:
                raise ProcessError(f"ended with exit code {code}: {words[-1]}")
            return {FIGURES_FILE: json.dumps({"reason": words[-1]}).encode()}


def _said(files: dict[str, bytes]) -> str:
    figures: dict[str, Any] = json.loads(files[FIGURES_FILE])
    if "reason" in figures:
        return f"no map: {figures['reason']}"
    return f"F visible {figures['visible']['f']:.3f}, objects {figures['objects']['f']:.3f}"
