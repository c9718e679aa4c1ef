"""Sketches tell replicas apart: whatever differs, by how much, and where."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.blocks import BLOCK_POSITIONS, PAGE_BYTES, PART_BYTES, PART_CELLS, SKETCHES, BlockLayout

POSITIONS, DIRECTIONS = 3 * BLOCK_POSITIONS + 10, 42
LAYOUT = BlockLayout((POSITIONS, DIRECTIONS))
TOLERANCE = 1e-5


def field() -> np.ndarray:
    return np.random.default_rng(1).uniform(0, 2, (POSITIONS, DIRECTIONS)).astype(np.float32)


def test_blocks_cover_every_position_once() -> None:
    rows = LAYOUT.rows_of(np.arange(LAYOUT.count, dtype=np.int32))

    assert rows.tolist() == list(range(POSITIONS))
    assert LAYOUT.rows_of(np.array([3], np.int32)).size == 10
    assert LAYOUT.rows_of(np.empty(0, np.int32)).size == 0


def test_equal_fields_have_equal_sketches() -> None:
    assert LAYOUT.sketch(field(), 20).shape == (LAYOUT.count, SKETCHES)
    assert LAYOUT.differing(LAYOUT.sketch(field(), 20), LAYOUT.sketch(field(), 20), 0.0) == []


@settings(max_examples=200, deadline=None, derandomize=True)
@given(position=st.integers(0, POSITIONS - 1), direction=st.integers(0, DIRECTIONS - 1))
def test_a_single_cell_that_differs_is_found_wherever_it_is(position: int, direction: int) -> None:
    phi = field()
    phi[position, direction] += np.float32(0.01)

    assert LAYOUT.differing(LAYOUT.sketch(phi, 20), LAYOUT.sketch(field(), 20), TOLERANCE) == [
        position // BLOCK_POSITIONS
    ]


@settings(max_examples=200, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10_000))
def test_differences_that_cancel_in_the_mean_are_found(seed: int) -> None:
    """Random ones of 1e-3 root mean square with zero mean: 100 times the tolerance."""
    other = field()
    change = np.random.default_rng(seed).normal(0, 1e-3, (BLOCK_POSITIONS, DIRECTIONS))
    other[:BLOCK_POSITIONS] += (change - change.mean()).astype(np.float32)

    assert LAYOUT.differing(LAYOUT.sketch(other, 20), LAYOUT.sketch(field(), 20), TOLERANCE) == [0]


def test_the_projections_estimate_the_root_mean_square_difference() -> None:
    squares = []
    for seed in range(200):
        other = field()
        other += np.random.default_rng(seed).normal(0, 1e-2, other.shape).astype(np.float32)
        apart = LAYOUT.sketch(other, 20).astype(float) - LAYOUT.sketch(field(), 20)
        squares.append((apart[:, 1:] ** 2).mean())

    assert np.sqrt(np.mean(squares)) == pytest.approx(1e-2, rel=0.1)


def test_a_difference_just_above_the_tolerance_is_found_within_seconds() -> None:
    other = field()
    other += np.random.default_rng(5).choice([-1.5e-5, 1.5e-5], other.shape).astype(np.float32)
    found: set[int] = set()
    for tick in range(20, 220, 20):
        found |= set(LAYOUT.differing(LAYOUT.sketch(other, tick), LAYOUT.sketch(field(), tick), TOLERANCE))

    assert found == set(range(LAYOUT.count))


def test_rounding_alone_is_below_the_tolerance() -> None:
    """What another processor's float32 arithmetic adds up to: an error of 1e-6 in every cell."""
    other = field() * (1 + np.random.default_rng(3).normal(0, 1e-6, (POSITIONS, DIRECTIONS))).astype(np.float32)

    assert LAYOUT.differing(LAYOUT.sketch(other, 20), LAYOUT.sketch(field(), 20), TOLERANCE) == []


def test_a_small_field_is_sketched_at_once() -> None:
    assert LAYOUT.parts == (range(LAYOUT.count),)
    assert [tick for tick in range(40) if LAYOUT.parts_due(tick, 20)] == [0, 20]


@pytest.mark.parametrize("shape", [(72_000, 208), (300_000, 1), (500, 40_000), (1, 10**7)])
@pytest.mark.parametrize("period", [1, 7, 20])
def test_a_large_field_is_sketched_in_parts_each_once_a_period(shape: tuple[int, int], period: int) -> None:
    layout = BlockLayout(shape)
    due = [part for tick in range(300, 300 + period) for part in layout.parts_due(tick, period)]

    assert sorted(block for part in due for block in part) == list(range(layout.count))
    assert max(len(part) for part in due) * SKETCHES * 4 <= PART_BYTES
    assert len(layout.parts) == layout.count or all(
        len(part) * BLOCK_POSITIONS * shape[1] <= 1.1 * PART_CELLS for part in due
    )
    if len(layout.parts) <= period:
        assert max(len(layout.parts_due(tick, period)) for tick in range(period)) <= 1


def test_parts_have_the_sketches_that_the_whole_has() -> None:
    whole = LAYOUT.sketch(field(), 20)
    for blocks in (range(2), range(2, 3), range(1, LAYOUT.count)):
        assert LAYOUT.sketch(field(), 20, blocks) == pytest.approx(whole[blocks.start : blocks.stop], rel=1e-5)


@pytest.mark.parametrize("directions", [42, 208, 5000])
def test_a_page_holds_what_fits_and_at_least_one_block(directions: int) -> None:
    blocks = BlockLayout((1000, directions)).blocks_a_page()

    assert blocks >= 1
    assert blocks == 1 or blocks * BLOCK_POSITIONS * directions * 4 <= PAGE_BYTES
