"""Flights in turn, by an executor that flies none: what is kept, what is told, and how many are under way."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Self

import pytest

from deploy.bench.campaign import fly_all, left_of
from deploy.bench.plan import Job, Wish, paper_jobs
from ground_station.results import versions
from ground_station.study.plan_file import FLIGHTS_FOLDER
from protocol.errors import ProcessError, StorageError
from protocol.guard import ROOT

JOBS = paper_jobs(Wish(ROOT / "missions" / "paper.toml", 100.0, 2, {}), ("none", "grid"))


class Pretender:
    """Flies in no time. ``outcomes``: what befalls flights by their name."""

    def __init__(self, slots: int, outcomes: dict[str, str] | None = None) -> None:
        self.slots, self._outcomes = slots, outcomes or {}
        self.flown: list[str] = []
        self.most = self._flying = 0
        self.released = False

    @asynccontextmanager
    async def ready(self) -> AsyncIterator[None]:
        yield
        self.released = True

    async def fly(self, name: str, mission_json: str) -> dict[str, bytes]:
        self._flying += 1
        self.most = max(self.most, self._flying)
        try:
            await asyncio.sleep(0)
            self.flown.append(name)
            outcome = self._outcomes.get(name)
            if outcome == "fails":
                raise ProcessError("the simulator died")
            found = {"numba": "0"} if outcome == "foreign" else versions()
            summary = {"J": 0.2, "f_score_visible": None, "versions": found}
            return {"summary.json": json.dumps(summary).encode(), "mission.json": mission_json.encode()}
        finally:
            self._flying -= 1

    def flown_s(self) -> dict[str, float]:
        return {}


class Listener:
    def __init__(self) -> None:
        self.told: dict[str, tuple[str, bool]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return

    def say(self, text: str) -> None: ...
    def began(self, name: str) -> None: ...
    def flown(self, shares: dict[str, float]) -> None: ...

    def ended(self, name: str, text: str, *, well: bool) -> None:
        self.told[name] = (text, well)


def names(jobs: list[Job]) -> list[str]:
    return [job.planned.name for job in jobs]


async def test_all_are_flown_in_order_no_more_at_a_time_than_there_are_slots(tmp_path: Path) -> None:
    pretender = Pretender(slots=2)
    assert await fly_all(tmp_path, JOBS, pretender, Listener()) == 0
    assert pretender.flown == names(JOBS)
    assert pretender.most == 2
    assert pretender.released
    assert left_of(tmp_path, JOBS) == []
    kept = tmp_path / FLIGHTS_FOLDER / JOBS[0].planned.folder / "mission.json"
    assert json.loads(kept.read_text())["seed"] == JOBS[0].planned.seed


async def test_a_flight_that_fails_is_told_and_left_for_the_next_time_and_the_others_fly(tmp_path: Path) -> None:
    bad = JOBS[1].planned.name
    listener = Listener()
    assert await fly_all(tmp_path, JOBS, Pretender(1, {bad: "fails"}), listener) == 1
    assert names(left_of(tmp_path, JOBS)) == [bad]
    assert listener.told[bad] == ("failed: the simulator died", False)
    assert sum(well for _, well in listener.told.values()) == len(JOBS) - 1
    again = Pretender(1)
    assert await fly_all(tmp_path, left_of(tmp_path, JOBS), again, Listener()) == 0
    assert again.flown == [bad]


async def test_a_flight_by_other_versions_than_ours_is_not_kept(tmp_path: Path) -> None:
    foreign = JOBS[0].planned.name
    listener = Listener()
    assert await fly_all(tmp_path, JOBS, Pretender(1, {foreign: "foreign"}), listener) == 1
    assert names(left_of(tmp_path, JOBS)) == [foreign]
    assert "flown by other versions than these" in listener.told[foreign][0]


async def test_two_studies_never_fly_in_one_folder(tmp_path: Path) -> None:
    first = asyncio.create_task(fly_all(tmp_path, JOBS, Pretender(1), Listener()))
    await asyncio.sleep(0)  # it begins
    await asyncio.sleep(0)
    with pytest.raises(ProcessError, match="another study is being flown here"):
        await fly_all(tmp_path, JOBS, Pretender(1), Listener())
    assert await first == 0


async def test_a_disk_that_refuses_a_flight_ends_the_study(tmp_path: Path) -> None:
    (tmp_path / FLIGHTS_FOLDER).mkdir()
    (tmp_path / FLIGHTS_FOLDER / JOBS[0].planned.folder).touch()
    pretender = Pretender(slots=2)
    with pytest.raises(StorageError):
        await fly_all(tmp_path, JOBS, pretender, Listener())
    assert len(pretender.flown) < len(JOBS)
