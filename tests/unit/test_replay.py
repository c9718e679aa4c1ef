"""What a replay takes from the recording and what it computes anew, with a map that changes as it is told."""

from __future__ import annotations

from collections.abc import Iterable
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from ground_station.feedback import FeedbackSchedule
from ground_station.mapper import Mapper, MapUpdate
from ground_station.reconstruction.reconstructor import Mesh
from ground_station.recording.entries import HandOver, Input, IntegratedTick, JumpRecord, Look
from ground_station.replay.comparison import Comparison
from ground_station.replay.engine import Replay
from protocol import messages
from protocol.field import VirtualField
from protocol.importance import ImportanceField
from protocol.map_settings import Feedback
from protocol.mission import Drone, Mission, Target

FLOWN = Mission(
    target=Target(lower_m=(-1, -1, 0), upper_m=(1, 1, 1), cell_m=0.5, cell_rad=0.8),
    feedback=Feedback(threshold=1.0, period_s=2.0, delay_s=1.0),
    drones=(Drone(id=1, start=(0, 0, 2, 0, 1.4)),),
)
FIELD = VirtualField.of(FLOWN.target)
PERIOD, DELAY = 40, 20
LATE = 13
"""Ticks by which a jump was late in flight."""
LAST = 170
POSES = np.array([[0.1, -0.2, 1.4, 0.3, 1.4]])


class Script:
    """The map: its n-th update changes every position by n hundredths."""

    def __init__(self) -> None:
        self.updates = 0

    def add(self, keyframes: Iterable[messages.Keyframe]) -> None:
        """Images say nothing here."""

    def update(self, *, scored: bool) -> MapUpdate:
        del scored
        self.updates += 1
        return MapUpdate(Mesh.empty(), change(self.updates), None)


def change(number: int) -> NDArray[np.float32]:
    return np.full(FIELD.shape[0], 0.01 * number, np.float32)


def flight(jumps: dict[int, list[NDArray[np.float32]]], gain: float = 1.0) -> list[Input]:
    """What the ground station did: ``jumps`` by the tick of their look, each ``LATE``; without one, none was told."""
    field = ImportanceField(FIELD, FLOWN.sensing)
    told = {}
    entries: list[Input] = []
    for tick in range(LAST + 1):
        for jump in [jump for jump in told.values() if jump.tick == tick]:
            field.jump(jump.increments)
        field.advance(POSES, FLOWN.tick_s)
        entries.append(IntegratedTick(tick, (1,), POSES))
        if tick and tick % PERIOD == 0:
            entries.append(Look(tick, field.importance))
            if tick in jumps:
                increments = sum(jumps[tick][1:], jumps[tick][0]) * np.float32(gain)
                told[tick] = messages.Jump(epoch=7, sequence=len(told), tick=tick + DELAY + LATE, increments=increments)
                entries.append(JumpRecord(tick, told[tick]))
    return entries


def replay(entries: Iterable[Input], mission: Mission = FLOWN) -> Replay:
    entries = list(entries)
    jumped = [entry.look for entry in entries if isinstance(entry, JumpRecord)]
    replay = Replay(FLOWN, mission, cast("Mapper", Script()), jumped)
    for entry in entries:
        replay.feed(entry)
    return replay


def expected(jumps: dict[int, NDArray[np.float32]]) -> str:
    """Hash of phi after jumps by the tick at which they take effect."""
    field = ImportanceField(FIELD, FLOWN.sensing)
    for tick in range(LAST + 1):
        if tick in jumps:
            field.jump(jumps[tick])
        field.advance(POSES, FLOWN.tick_s)
    return field.sha256


def with_feedback(**settings: float) -> Mission:
    return FLOWN.model_copy(update={"feedback": FLOWN.feedback.model_copy(update=settings)})


def test_a_jump_that_was_late_in_flight_is_as_late_again() -> None:
    again = replay(flight({40: [change(1)], 80: [change(2)], 120: [change(3)]}))

    assert again.comparison == Comparison("", looks=4, jumps=3)
    assert again.field.sha256 == expected({73: change(1), 113: change(2), 153: change(3)})
    assert again.metrics().jumps == 3


def test_a_jump_that_the_disk_refused_is_part_of_the_next_as_it_was() -> None:
    again = replay(flight({80: [change(2), change(1)]}))

    assert again.comparison == Comparison("", looks=4, jumps=1)
    assert again.field.sha256 == expected({113: change(2) + change(1)})


def test_what_came_too_late_for_any_jump_has_none() -> None:
    again = replay(flight({40: [change(1)]}))

    assert again.comparison.difference == ""
    assert again.field.sha256 == expected({73: change(1)})


def test_other_feedback_jumps_when_the_flight_did_and_else_in_time() -> None:
    again = replay(flight({40: [change(1)], 120: [change(3)]}), with_feedback(gain=0.5))

    half = np.float32(0.5)
    assert again.field.sha256 == expected({73: half * change(1), 100: half * change(2), 153: half * change(3)})
    assert again.comparison.difference.startswith("tick 73: jump 0, from the map of tick 40, differs at 32 of 32")


def test_another_period_looks_at_its_own_ticks() -> None:
    again = replay(flight({40: [change(1)]}), with_feedback(period_s=3.0))

    assert again.field.sha256 == expected({60 + DELAY: change(1), 120 + DELAY: change(2)})


def test_without_feedback_nothing_jumps() -> None:
    again = replay(flight({40: [change(1)]}), with_feedback(gain=0.0))

    assert again.field.sha256 == expected({})
    assert again.comparison.difference == "tick 73: jump 0, from the map of tick 40, does not come about in the replay"


def test_the_first_tick_that_is_missing_is_told() -> None:
    entries = [entry for entry in flight({}) if not (isinstance(entry, IntegratedTick) and 50 <= entry.tick < 60)]

    assert replay(entries).comparison.difference == "tick 50: the recording goes on with tick 60"


def test_an_image_that_is_missing_is_told() -> None:
    entries = [HandOver(1, (), missing=((1, 0), (1, 1))), *flight({})]

    assert replay(entries).comparison.difference == "tick 1: the recording lacks 2 keyframes that the map has"


def test_an_importance_that_differs_is_told_to_the_last_digit() -> None:
    entries = [Look(entry.tick, 0.5) if isinstance(entry, Look) else entry for entry in flight({})]

    assert replay(entries).comparison.difference.startswith("tick 40: J was 0.5, and is 0.8578")


def test_all_later_differences_follow_from_the_first() -> None:
    comparison = Comparison()
    comparison.end(9, {"phi_sha256": "ab" * 32, "mesh_sha256": None}, "ab" * 32, None)
    assert comparison.difference == ""

    comparison.end(10, {"phi_sha256": "ab" * 32, "mesh_sha256": "cd" * 32}, "ab" * 32, None)
    comparison.end(11, {"phi_sha256": "ab" * 32, "mesh_sha256": None}, "ef" * 32, None)

    assert comparison.difference == "tick 10: the final mesh was cdcdcdcdcdcdcdcd..., and is none in the replay"


@pytest.mark.parametrize("tick", [PERIOD, 3 * PERIOD])
def test_the_schedule_of_these_tests_is_the_missions(tick: int) -> None:
    schedule = FeedbackSchedule(FLOWN.feedback, FLOWN.tick_s)

    assert schedule.is_due(tick)
    assert schedule.effective_tick(tick) == tick + DELAY
