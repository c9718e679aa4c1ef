"""The display is fed over a real bus."""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Self

import pytest

from deploy.progress import follow
from deploy.run_folder import socket_endpoint, socket_folder_parent
from protocol.bus import connect
from protocol.guard import ROOT
from protocol.messages import ReplicaState, Status
from protocol.mission_file import load_mission
from protocol.topics import STATUS

DEMO = load_mission(ROOT / "missions" / "demo.toml")
PATIENCE_S = 30.0


class Recorder:
    """A display that keeps what it is given."""

    def __init__(self) -> None:
        self.statuses: list[Status] = []
        self.said: list[str] = []
        self.first = asyncio.Event()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return

    def say(self, text: str) -> None:
        self.said.append(text)

    def show(self, status: Status) -> None:
        self.statuses.append(status)
        self.first.set()


@pytest.fixture
def endpoint() -> Iterator[str]:
    with tempfile.TemporaryDirectory(dir=socket_folder_parent()) as folder:
        yield socket_endpoint(Path(folder))


async def test_what_the_ground_station_publishes_is_shown(endpoint: str) -> None:
    status = Status(
        phase="flying",
        activity="mapping",
        tick=20,
        time_s=1.0,
        importance=0.9,
        f_score_visible=0.1,
        f_score_objects=0.1,
        keyframes=3,
        dropped=0,
        replica=ReplicaState(tick=0, epoch=0, next_jump=0, missing=0, repaired=0, lost=0),
        refused=0,
        unwritten=0,
        loop_lag_s=0.0,
        keyframes_per_s=2.0,
        jumps=0,
        min_separation_m=1.5,
        drones=(),
    )
    display = Recorder()

    # The display is there first, as in a run: it has to wait for the router.
    watching = asyncio.create_task(follow(endpoint, DEMO, display))
    async with connect(endpoint, DEMO.name, router=True) as ground, asyncio.timeout(PATIENCE_S):
        while not display.first.is_set():
            ground.put(STATUS, status)
            with suppress(TimeoutError):
                await asyncio.wait_for(display.first.wait(), 0.1)
        watching.cancel()
        with pytest.raises(asyncio.CancelledError):
            await watching

    assert display.statuses[0] == status
    assert display.said == []


async def test_an_unreachable_ground_station_is_told_and_nothing_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("deploy.progress.CONNECT_S", 0.0)
    display = Recorder()

    await follow("unixsock-stream//nowhere/z.sock", DEMO, display)

    assert len(display.said) == 1
    assert display.said[0].startswith("no progress to show: cannot reach unixsock-stream//nowhere/z.sock")
