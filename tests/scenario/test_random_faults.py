"""Missions under random faults, in virtual time: whatever happened, phi and the drones come out well.

`python -m faults.random_schedules` flies many more of them (`make faults`).
"""

from __future__ import annotations

from pathlib import Path

import pytest

from faults.schedule import FAULTY_S, FLIGHT_S, schedule
from faults.trial import fly

SEEDS = range(8)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_team_comes_through_random_faults(seed: int, tmp_path: Path) -> None:
    planned = schedule(seed)
    outcome = fly(planned, tmp_path)
    assert not outcome.violations, f"{planned}\n" + "\n".join(outcome.violations)


def test_the_same_seed_is_the_same_flight_byte_for_byte(tmp_path: Path) -> None:
    planned = next(planned for planned in map(schedule, range(100)) if len(planned.mission.drones) == 1)
    first, second = (fly(planned, tmp_path / name) for name in ("first", "second"))
    assert first.digest == second.digest
    assert first.digest != fly(schedule(planned.seed + 1000), tmp_path / "other").digest


def test_schedules_heal_in_time_and_hold_every_kind_of_fault() -> None:
    planned = [schedule(seed) for seed in range(200)]
    events = [event for each in planned for event in each.events]
    assert all(0.0 <= event.begin_s < event.end_s <= FAULTY_S < FLIGHT_S for event in events)
    assert {event.kind for event in events} == {
        "loss", "delay", "reorder", "duplicate", "garble", "narrow", "black hole", "reset", "freeze", "kill",
        "kill at jump", "late join", "skew", "noise", "disk full",
    }  # fmt: skip
    assert {len(each.mission.drones) for each in planned} == {1, 2, 3, 4, 5}
    assert schedule(7) == schedule(7) != schedule(8)
