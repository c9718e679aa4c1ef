"""However jumps arrive, every process ends with the same bytes of phi."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.field import VirtualField
from protocol.importance import ImportanceField
from protocol.messages import Jump
from protocol.mission import Sensing, Target
from protocol.replica import Replica

FIELD = VirtualField.of(Target(cell_m=1.0, cell_rad=1.0))
POSITIONS = FIELD.shape[0]
EPOCH = 77
TICK_S = 0.05
TICKS = 12
JUMP_TICKS = (2, 2, 3, 5, 8, 8, 9)
"""Ticks at which the jumps of a mission take effect, by sequence number."""


def jump(sequence: int, tick: int, epoch: int = EPOCH) -> Jump:
    increments = np.random.default_rng(sequence).uniform(0, 1, POSITIONS).astype(np.float32)
    return Jump(epoch=epoch, sequence=sequence, tick=tick, increments=increments)


JUMPS = tuple(jump(sequence, tick) for sequence, tick in enumerate(JUMP_TICKS))


def replica(epoch: int = 0) -> Replica:
    return Replica(ImportanceField(FIELD, Sensing()), epoch)


def poses_at(tick: int) -> np.ndarray:
    return np.array([[0.2 * tick - 1, 0.1, 1.6, 0.3 * tick, 1.3], [1.0, 0.2 * tick - 1, 1.5, -0.2 * tick, 1.4]])


def fly(flown: Replica) -> list[str]:
    """Digests of phi after each tick of a replica that already has all jumps."""
    digests = []
    for tick in range(TICKS):
        flown.advance(tick, poses_at(tick), TICK_S)
        digests.append(flown.field.sha256)
    return digests


def in_order() -> Replica:
    complete = replica()
    for each in JUMPS:
        complete.hear(each)
    return complete


EXPECTED = fly(in_order())


@settings(max_examples=100, deadline=None, derandomize=True)
@given(
    arrivals=st.lists(st.tuples(st.integers(0, TICKS - 1), st.integers(0, len(JUMPS) - 1)), max_size=25),
)
def test_reordered_repeated_and_lost_jumps_end_in_the_same_bytes_at_every_tick(arrivals: list[tuple[int, int]]) -> None:
    """Jumps arrive at any tick, in any order, often or never; what is due and missing is fetched from the journal."""
    replicated = replica()
    digests = []
    for tick in range(TICKS):
        for when, sequence in arrivals:
            if when == tick:
                replicated.hear(JUMPS[sequence])
        due = sum(each.tick <= tick for each in JUMPS)
        for sequence in range(replicated.jumps.next_sequence, due):
            replicated.hear(JUMPS[sequence])
        replicated.advance(tick, poses_at(tick), TICK_S)
        digests.append(replicated.field.sha256)

    assert digests == EXPECTED
    assert replicated.refused == 0


def test_a_jump_takes_effect_at_its_tick_and_not_before() -> None:
    early = replica()
    early.hear(jump(0, tick=3))
    alone = replica()
    for tick in range(3):
        early.advance(tick, poses_at(tick), TICK_S)
        alone.advance(tick, poses_at(tick), TICK_S)
        assert early.field.sha256 == alone.field.sha256

    alone.field.jump(jump(0, tick=3).increments)
    early.advance(3, poses_at(3), TICK_S)
    alone.advance(3, poses_at(3), TICK_S)

    assert early.field.sha256 == alone.field.sha256
    assert early.field.importance == alone.field.importance > 1.0


def test_a_jump_that_comes_after_its_tick_takes_effect_at_once() -> None:
    late = replica()
    late.advance(0, poses_at(0), TICK_S)
    before = late.field.importance
    late.hear(jump(0, tick=0))
    late.advance(1, poses_at(1), TICK_S)

    assert late.field.importance > before + 0.4


def test_a_gap_is_told_until_it_is_filled() -> None:
    waiting = replica()
    assert waiting.jumps.gap is None
    waiting.hear(JUMPS[0])
    assert waiting.jumps.gap is None
    waiting.hear(JUMPS[5])
    waiting.hear(JUMPS[3])
    assert waiting.jumps.gap == (1, 3)
    waiting.hear(JUMPS[1])
    assert waiting.jumps.gap == (2, 3)
    waiting.hear(JUMPS[2])
    assert waiting.jumps.gap == (4, 5)
    waiting.hear(JUMPS[4])
    assert waiting.jumps.gap is None
    assert waiting.jumps.next_sequence == 6


def test_a_jump_behind_a_gap_is_not_applied_also_when_it_is_due() -> None:
    waiting = replica()
    waiting.hear(jump(1, tick=0))
    waiting.advance(5, np.empty((0, 5)), TICK_S)
    assert (waiting.field.phi == 1).all()

    waiting.hear(jump(0, tick=0))
    waiting.advance(6, np.empty((0, 5)), TICK_S)
    assert waiting.field.phi[:, 0] == pytest.approx(1 + jump(0, 0).increments + jump(1, 0).increments)


def test_a_jump_of_another_epoch_is_refused_and_counted() -> None:
    known = replica(EPOCH)
    known.hear(jump(0, tick=0, epoch=EPOCH + 1))
    assert (known.refused, known.jumps.next_sequence, known.jumps.gap) == (1, 0, None)

    learns = replica()
    learns.hear(JUMPS[0])
    learns.hear(jump(1, tick=0, epoch=EPOCH + 1))
    assert (learns.jumps.epoch, learns.refused, learns.jumps.next_sequence) == (EPOCH, 1, 1)


@pytest.mark.parametrize(
    "increments",
    [
        np.ones(POSITIONS - 1, np.float32),
        np.ones((POSITIONS, 1), np.float32),
        np.ones(1, np.float32),
        np.ones(POSITIONS, np.float64),
        np.ones(POSITIONS, np.int32),
    ],
    ids=["too short", "two axes", "one that would broadcast", "doubles", "whole numbers"],
)
def test_increments_that_do_not_fit_the_field_are_refused_and_decide_nothing(increments: np.ndarray) -> None:
    fresh = replica()
    fresh.hear(Jump(epoch=EPOCH + 1, sequence=0, tick=0, increments=increments))
    fresh.advance(0, np.empty((0, 5)), TICK_S)

    assert fresh.refused == 1
    assert (fresh.field.phi == 1).all()
    assert fresh.jumps.epoch == 0, "a message that is refused must not tell the epoch"
    fresh.hear(JUMPS[0])
    assert fresh.jumps.next_sequence == 1
