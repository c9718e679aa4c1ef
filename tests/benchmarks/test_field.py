"""The kernel over the field of 1.5e7 cells that the paper prints: what a tick takes, and with what it grows."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from faults.dense_field import dense_tick
from faults.measure import cpu_s, median_s
from protocol.field import VirtualField
from protocol.geometry import Floats
from protocol.importance import ImportanceField
from protocol.mission import Sensing, Target
from protocol.mission_file import load_mission

Record = Callable[..., None]
FULL = load_mission(Path(__file__).parents[2] / "missions" / "paper-full.toml").target
DT = 0.05
TICKS = 200
DENSE_POSITIONS = 1920
"""Taken at a time by the plain form: 4e5 cells. From 6e3 to 4e5 it is equally fast; all at once would take 10 GB."""
STARTS = np.array(
    [(0.0, 1.0, 2.0, 0.0, 1.3), (2.0, 1.0, 2.0, 1.0, 1.4), (-2.0, 1.0, 2.0, 2.0, 1.2), (0.0, -2.0, 2.0, 3.0, 1.3)]
)
SQUARE = np.array([(x, y, 2.0, 0.3, 1.3) for x in (-2.25, -0.75, 0.75, 2.25) for y in (-2.25, -0.75, 0.75, 2.25)])
"""Sixteen drones, a metre and a half apart: their cones hardly meet."""


def team_at(tick: int) -> Floats:
    """Four drones that fly in circles of half a metre and turn; at tick 0 at their starts."""
    angle = 0.03 * tick
    moved: Floats = STARTS + np.array([0.5 * np.sin(angle), 0.5 * np.cos(angle) - 0.5, 0.0, angle, 0.0])
    return moved


def dense_s(field: VirtualField, poses: Floats, sensing: Sensing) -> tuple[float, Floats]:
    """CPU seconds of a tick of the plain form over all cells, and drone 0's gradient (5,). The list of the cells is not
    counted: a plain program would keep it."""
    places, taken, gradient = field.positions(), 0.0, np.zeros(5)
    for first in range(0, len(places), DENSE_POSITIONS):
        chosen = places[first : first + DENSE_POSITIONS]
        cells, views = chosen.repeat(len(field.directions), axis=0), np.tile(field.directions, (len(chosen), 1))
        phi = np.ones(len(cells))
        began = time.process_time()
        gradient += dense_tick(phi, cells, views, poses, sensing, DT)
        taken += time.process_time() - began
    return taken, gradient


@pytest.mark.timeout(300)
def test_tick_of_the_full_field(record: Record) -> None:
    """Team decay and one drone's terms, four drones; the issue's bars are 50 ms a tick, and 300 times."""
    field, sensing = VirtualField.of(FULL), Sensing()
    importance = ImportanceField(field, sensing)
    dense, gradient = dense_s(field, team_at(0), sensing)
    terms = importance.terms(team_at(0), 0)
    assert np.allclose(terms.gradient, gradient, rtol=1e-4, atol=1e-4 * np.abs(gradient).max())
    ticks = iter(range(TICKS))
    taken = cpu_s(lambda: importance.advance(team_at(next(ticks)), DT, 0), TICKS)
    median, p99 = np.percentile(taken, [50, 99])
    record("field_tick_15e6", median * 1e3, "ms CPU", "NumPy over all cells, as printed", dense / median)
    record("field_tick_15e6_p99", p99 * 1e3, "ms CPU", "a tick of 50 ms", 0.05 / p99)


def test_growth_with_the_field(record: Record) -> None:
    """The default lattice in an ever larger box: four drones see the same cells of it."""
    curve = []
    for times in (1, 2, 4, 8, 16, 32, 64, 128):
        half_m = 3.0 * times**0.5
        target = Target(lower_m=(-half_m, -half_m, 0.0), upper_m=(half_m, half_m, 2.0))
        importance = ImportanceField(VirtualField.of(target), Sensing())
        tick = median_s(lambda kept=importance: [kept.advance(STARTS, DT, 0) for _ in range(20)], 15) / 20
        curve.append((importance.field.size, tick * 1e3))
    (least, first), (most, last) = curve[0], curve[-1]
    grown = last / first
    record(
        "field_tick_growth_m", grown, "x, 1.2e5 to 1.5e7 cells", "visiting all cells", most / least / grown, curve=curve
    )


def test_growth_with_the_team(record: Record) -> None:
    """One to sixteen drones over the full field; in proportion is 16 times."""
    importance = ImportanceField(VirtualField.of(FULL), Sensing())
    spread = SQUARE[np.random.default_rng(1).permutation(len(SQUARE))]
    curve = []
    for drones in (1, 2, 4, 6, 8, 10, 12, 14, 16):
        tick = median_s(lambda poses=spread[:drones]: importance.advance(poses, DT, 0), 31)
        curve.append((drones, tick * 1e3))
    grown = curve[-1][1] / curve[0][1]
    record("field_tick_growth_n", grown, "x, 1 to 16 drones", "in proportion", 16 / grown, curve=curve)
