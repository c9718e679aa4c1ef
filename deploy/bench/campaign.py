"""Flies what a study still lacks, some flights at a time, and keeps each as soon as it is whole."""

from __future__ import annotations

import asyncio
import fcntl
import json
import os
import shutil
import signal
import time
from collections import deque
from collections.abc import Coroutine, Iterator, Mapping, Sequence
from contextlib import AsyncExitStack, contextmanager
from pathlib import Path
from typing import Any

from deploy.bench.executors import Executor
from deploy.bench.flight import keep
from deploy.bench.plan import Job
from deploy.bench.progress import Watch
from deploy.local import interruption
from ground_station.results import SUMMARY_FILE, versions
from ground_station.study.plan_file import FLIGHTS_FOLDER, PlannedFlight
from protocol.errors import ProcessError, StorageError
from protocol.mission_file import mission_to_json

LOOK_S = 2.0
"""How often it is looked how far flights are."""


def left_of(folder: Path, jobs: Sequence[Job]) -> list[Job]:
    """Those that are not flown yet, in an order that leaves no core idle at the end: the first seeds first, and of a
    seed the large teams."""
    left = [job for job in jobs if not (folder / FLIGHTS_FOLDER / job.planned.folder).is_dir()]
    return sorted(left, key=lambda job: (job.planned.seed, -job.planned.drones))


async def fly_all(folder: Path, jobs: Sequence[Job], executor: Executor, watch: Watch) -> int:
    """Fly ``jobs`` into the study's folder; the exit code, as of `until_interrupted`.

    A flight that fails is told, and the others fly on. After a signal the flights under way are ended and forgotten.
    """
    return await until_interrupted(_Campaign(folder, jobs, executor, watch).run(), "flights", watch)


async def until_interrupted(work: Coroutine[Any, Any, int], what: str, watch: Watch) -> int:
    """Await ``work``, which says how many failed; the exit code: 0, 1 if any did, 128 + n if signal n ended it."""
    with interruption() as interrupted:
        working = asyncio.create_task(work)
        watched: set[asyncio.Future[Any]] = {working, interrupted}
        await asyncio.wait(watched, return_when=asyncio.FIRST_COMPLETED)
        if working.done():
            return 1 if working.result() else 0
        number: signal.Signals = interrupted.result()
        watch.say(f"{number.name}: ending the {what}; the same command goes on with those that are left")
        working.cancel()
        await asyncio.gather(working, return_exceptions=True)
        return 128 + number


class _Campaign:
    def __init__(self, folder: Path, jobs: Sequence[Job], executor: Executor, watch: Watch) -> None:
        self._flights, self._waiting = folder / FLIGHTS_FOLDER, deque(jobs)
        self._executor, self._watch = executor, watch
        self._durations = {job.planned.name: job.mission.duration_s for job in jobs}
        self._failed = 0

    async def run(self) -> int:
        """How many failed."""
        self._flights.mkdir(parents=True, exist_ok=True)
        async with AsyncExitStack() as stack:
            stack.enter_context(alone(self._flights))
            for draft in self._flights.glob(".*.draft"):
                shutil.rmtree(draft)
            await stack.enter_async_context(self._executor.ready())
            looking = asyncio.create_task(self._look())
            try:
                async with asyncio.TaskGroup() as crew:
                    for _ in range(min(self._executor.slots, len(self._waiting))):
                        crew.create_task(self._fly_in_turn())
            except ExceptionGroup as failed:
                raise failed.exceptions[0] from None  # the others are of tasks that it ended
            finally:
                looking.cancel()
        return self._failed

    async def _fly_in_turn(self) -> None:
        while self._waiting:
            job = self._waiting.popleft()
            name, began_s = job.planned.name, time.monotonic()
            self._watch.began(name)
            try:
                files = await self._executor.fly(name, mission_to_json(job.mission))
                summary = self._checked(files)
            except ProcessError as error:
                self._failed += 1
                self._watch.ended(name, f"failed: {error}", well=False)
                continue
            self._keep(job.planned, files)
            f_score, wall_s = summary.get("f_score_visible"), time.monotonic() - began_s
            scored = "" if f_score is None else f", F visible {f_score:.3f}"
            self._watch.ended(name, f"J {summary['J']:.3f}{scored}, {wall_s:.0f} s", well=True)

    def _checked(self, files: Mapping[str, bytes]) -> Mapping[str, object]:
        """Its summary. Raises `ProcessError` if it was flown by other versions than those of its key."""
        summary: Mapping[str, object] = json.loads(files[SUMMARY_FILE])
        if summary["versions"] != versions():
            raise ProcessError(f"flown by other versions than these, {versions()}: {summary['versions']}")
        return summary

    def _keep(self, planned: PlannedFlight, files: Mapping[str, bytes]) -> None:
        try:
            keep(files, self._flights / planned.folder)
        except OSError as error:
            raise StorageError(f"{error.filename}: {error.strerror}") from error

    async def _look(self) -> None:
        while True:
            await asyncio.sleep(LOOK_S)
            flown = self._executor.flown_s()
            self._watch.flown({name: time_s / self._durations[name] for name, time_s in flown.items()})


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Two studies in one folder would fly the same flights. Raises `ProcessError` if another flies there."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    except BlockingIOError as error:
        raise ProcessError(f"{folder}: another study is being flown here") from error
    finally:
        os.close(descriptor)
