"""What becomes of keyframes when the map is slower than they come, and that none of it happens in lockstep."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import cast

import pytest

from faults.floor_flight import LEG, MISSION, fly
from faults.recorded_flight import RecordedFlight
from ground_station.jump_publisher import JumpPublisher
from ground_station.keyframe_backlog import KeyframeBacklog
from ground_station.keyframe_log import KeyframeLog
from ground_station.map_feedback import LOOKS_WAITING, MapFeedback
from ground_station.mapper import Mapper
from ground_station.reconstruction.reconstructor import NullReconstructor, Statistics
from ground_station.recording.entries import HandOver
from ground_station.recording.recorder import Recorder
from protocol.field import VirtualField
from protocol.messages import EventLevel, Keyframe
from protocol.mission import Mission

ROOM = 4
"""For keyframes that wait."""
TOO_LONG_S = 20.0


class SlowMapper(Mapper):
    """Takes its time until it is let go."""

    def __init__(self, mission: Mission, folder: Path, log: KeyframeLog) -> None:
        super().__init__(mission, VirtualField.of(mission.target), folder, log)
        self.may = threading.Event()
        self.mapped: list[Keyframe] = []

    def add(self, keyframes: Sequence[Keyframe]) -> None:
        assert self.may.wait(TOO_LONG_S)
        super().add(keyframes)
        self.mapped += keyframes


class Station:
    """The feedback with a real log, and who listens to it."""

    def __init__(self, mission: Mission, folder: Path, *, lockstep: bool, held_max: int = 100) -> None:
        self.log = KeyframeLog(folder / "keyframes")
        self.mapper = SlowMapper(mission, folder, self.log)
        self.recorder = RecordedFlight()
        self.told: list[tuple[EventLevel, str, str]] = []
        self.feedback = MapFeedback(
            mission,
            self.mapper,
            cast("JumpPublisher", None),  # importance stays high: none jumps
            cast("Recorder", self.recorder),
            lambda *event: self.told.append(event),
            lockstep=lockstep,
            backlog=KeyframeBacklog(mission.camera, ROOM, held_max),
        )

    def hear(self, keyframes: Sequence[Keyframe]) -> None:
        for keyframe in keyframes:
            self.feedback.hear(keyframe)
            self.feedback.hand_over(keyframe.tick + 1)

    @property
    def handed_over(self) -> list[Keyframe]:
        entries = [entry for entry in self.recorder.inputs if isinstance(entry, HandOver)]
        return [keyframe for entry in entries for keyframe in entry.keyframes]

    def logged(self) -> list[int]:
        return [keyframe.sequence for _, keyframe in self.log.read(0, self.log.end)]


Make = Callable[..., Station]


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Make]:
    stations: list[Station] = []

    def build(mission: Mission = MISSION, *, lockstep: bool = False, held_max: int = 100) -> Station:
        stations.append(Station(mission, tmp_path, lockstep=lockstep, held_max=held_max))
        return stations[-1]

    yield build
    for station in stations:
        station.mapper.may.set()
        station.feedback.close()
        station.log.close()


async def test_a_slow_map_passes_keyframes_over_and_says_so_once(make: Make) -> None:
    station, flight = make(), fly()
    station.hear(flight)
    feedback = station.feedback
    assert feedback.passed_over == LEG - ROOM - 1, "one is being mapped, and so many wait"
    assert feedback.backlog == ROOM + 1
    station.mapper.may.set()
    await feedback.finish()

    assert len(station.mapper.mapped) == ROOM + 1
    assert station.handed_over == station.mapper.mapped, "a replay maps the same ones"
    assert station.logged() == [keyframe.sequence for keyframe in flight], "covrecon reconstruct has them all"
    assert feedback.unused == LEG - ROOM - 1 + station.mapper.refused
    assert (feedback.backlog, feedback.handed) == (0, ROOM + 1)
    ((level, kind, text),) = station.told
    assert (level, kind) == ("warning", "map")
    assert "slower than images come" in text


async def test_a_map_that_keeps_up_passes_none_over(make: Make) -> None:
    station = make()
    station.mapper.may.set()
    for keyframe in fly():
        station.hear([keyframe])
        await asyncio.wait_for(asyncio.gather(*station.feedback._adding), TOO_LONG_S)
    await station.feedback.finish()
    assert len(station.mapper.mapped) == LEG
    assert station.feedback.passed_over == 0
    assert not station.told


async def test_in_lockstep_none_is_passed_over_however_slow_the_map_is(make: Make) -> None:
    station = make(lockstep=True)
    station.hear(fly())
    assert station.feedback.backlog == LEG
    station.mapper.may.set()
    await station.feedback.finish()
    assert len(station.mapper.mapped) == LEG
    assert not station.told


async def test_a_map_that_stands_still_has_no_more_held_for_it_than_there_is_room(make: Make) -> None:
    station = make(held_max=8)
    station.hear(fly())
    station.mapper.may.set()
    await station.feedback.finish()
    assert len(station.logged()) == 1 + 8
    assert station.feedback.unused == LEG - len(station.mapper.mapped) + station.mapper.refused


async def test_looks_at_a_slow_map_do_not_pile_up(make: Make) -> None:
    station = make()
    station.hear(fly()[:1])
    due = [tick for tick in range(1, 1000) if station.feedback._schedule.is_due(tick)]
    assert len(due) > 2 * LOOKS_WAITING
    for tick in due:
        station.feedback.look(tick, importance=1.0)
    assert len(station.feedback._updates) == LOOKS_WAITING
    station.mapper.may.set()
    await station.feedback.finish()


class Greedy(NullReconstructor):
    """A map that takes more memory than anyone thought."""

    def statistics(self) -> Statistics:
        return Statistics(0, 0, 0, {}, 10**10)


async def test_a_map_that_outgrows_its_limit_is_told_once(make: Make) -> None:
    station = make()
    station.mapper._reconstructor = Greedy()
    for tick in (40, 80, 120):
        station.feedback.look(tick, importance=1.0)
        await asyncio.wait_for(station.feedback._updates[0].task, TOO_LONG_S)
        await station.feedback.settle(tick)
    ((level, kind, text),) = station.told
    assert (level, kind) == ("warning", "map")
    assert "10000 MB" in text
    assert "memory_limit_mb 2048" in text
