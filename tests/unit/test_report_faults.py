"""What the report tells of as faults, and what it does not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from faults.told import told
from ground_station.report import content
from ground_station.report.content import fault_rows
from ground_station.report.faults import Fault, faults
from ground_station.report.run_data import History, Run, flight_of
from ground_station.report.spells import spells
from ground_station.trajectories import Trajectories
from protocol.messages import DroneState, Event
from protocol.mission import Drone, Mission

MISSION = Mission(name="m", drones=(Drone(id=1, start=(0, 0, 2, 0, 1.3)), Drone(id=2, start=(2, 0, 2, 0, 1.3))))
"""Ticks of 0.05 s."""
CALM = told()


def run(ticks: Sequence[Mapping[int, DroneState | None]], events: Sequence[Event] = (), apart_m: float = 2.0) -> Run:
    """Each tick's states by drone; one that is left out told nothing new and flies, None is not heard at all."""
    trajectories = Trajectories([1, 2])
    for tick, states in enumerate(ticks):
        heard = {drone: states.get(drone, CALM) for drone in (1, 2)}
        known = {drone: state for drone, state in heard.items() if state is not None}
        trajectories.add(tick, tick / 20, {drone: (drone * apart_m, 0.0, 2.0, 0.0, 1.3) for drone in known}, known)
    return Run(MISSION, {}, flight_of(trajectories.arrays()), None, None, History(events=events))


def test_a_calm_flight_has_none() -> None:
    landing = [{1: told(mode=mode), 2: told(mode=mode)} for mode in ("holding", "returning", "landing", "landed")]
    starting = [{1: told(mode="starting"), 2: told(mode="starting")}]
    assert faults(run([*starting, *[{}] * 5, *landing])) == []


def test_braking_is_told_once_a_spell_with_its_reasons() -> None:
    slow, impossible = told(outcome="out_of_time", mode="braking"), told(outcome="infeasible", mode="braking")
    ticks = [{}] * 10 + [{2: slow}, {2: impossible}, {}, {2: impossible}] + [{}] * 40 + [{2: slow}] + [{}]
    assert faults(run(ticks)) == [
        Fault(0.5, 0.7, "drone/2", "braked for 3 ticks: infeasible 2, out of time 1", "warning"),
        Fault(2.7, 2.75, "drone/2", "braked for 1 tick: out of time 1", "warning"),
    ]


def test_a_drone_that_leaves_early_is_told_but_not_the_end_of_the_mission() -> None:
    ticks = [{}] * 4 + [{2: told(mode="returning")}] * 2 + [{2: told(mode="landed")}] * 2
    ticks += [{1: told(mode="landing"), 2: told(mode="landed")}] * 2
    assert faults(run(ticks)) == [
        Fault(0.2, 0.3, "drone/2", "returning", "warning"),
        Fault(0.3, 0.45, "drone/2", "landed", "note"),
    ]


def test_a_pilot_who_takes_over_is_an_error() -> None:
    (fault,) = faults(run([{}, {1: told(mode="yielded")}, {}]))
    assert (fault.text, fault.severity) == ("yielded", "error")


def test_silence_is_told_when_it_lasts_and_not_before_the_first_word() -> None:
    late = [{1: None}] * 20
    short, long = [{1: None}] * 9, [{1: None}] * 11
    (fault,) = faults(run([*late, {}, *short, {}, *long, {}]))
    assert (fault.text, round(fault.start_s, 2), round(fault.end_s, 2)) == ("not heard", 1.55, 2.1)


def test_a_broken_barrier_is_told_with_its_worst_and_rounding_is_not() -> None:
    rounding = told(margins=(-1e-9, 1.0, 0.1))
    ticks = [{1: rounding}] * 3 + [{1: told(margins=(-0.02, 1.0, 0.1))}, {1: told(margins=(-0.05, 1.0, 0.1))}, {}]
    assert faults(run(ticks)) == [
        Fault(
            0.15,
            0.25,
            "drone/1",
            "inside the separation as lag and late commands widen it, -0.05 m² at worst",
            "warning",
        )
    ]


def test_a_region_s_margin_that_only_grew_is_no_broken_barrier_and_one_that_is_broken_beyond_that_is() -> None:
    grown = told(margins=(1.0, -0.1, 0.1), position_sd_m=0.05)
    broken = told(margins=(1.0, -0.2, 0.1), position_sd_m=0.05)
    sure = told(margins=(1.0, -0.1, 0.1))
    told_of = [(fault.text, fault.severity) for fault in faults(run([{}, {1: grown}, {}]))]
    assert told_of == [
        ("inside the flight region's margin, which grew with what its place may be off, -0.1 m at worst", "warning")
    ]
    for state, worst in ((broken, "-0.05"), (sure, "-0.1")):
        told_of = [(fault.text, fault.severity) for fault in faults(run([{}, {1: state}, {}]))]
        assert told_of == [(f"barrier of the flight region broken, {worst} m at worst", "error")]


def test_what_a_map_learns_beside_a_drone_is_a_note() -> None:
    ticks = [{1: told(obstacle_m=0.2)}, {1: told(obstacle_m=-0.04)}, {1: told(obstacle_m=-0.01)}, {}]
    assert faults(run(ticks)) == [
        Fault(0.05, 0.15, "drone/1", "nearer than its margin to what was not seen free, -0.04 m at worst", "note")
    ]


def test_drones_that_come_too_near_are_an_error() -> None:
    assert [(fault.source, fault.text, fault.severity) for fault in faults(run([{}, {}], apart_m=0.75))] == [
        ("drone/1", "0.750 m from another drone, less than 1 m", "error"),
        ("drone/2", "0.750 m from another drone, less than 1 m", "error"),
    ]


def test_warnings_of_processes_stand_between_what_was_seen_and_news_do_not() -> None:
    events = [
        Event(source="ground", tick=2, level="warning", kind="disk", text="full"),
        Event(source="drone/1", tick=0, level="info", kind="mode", text="flying"),
    ]
    told_of = [
        fault.text for fault in faults(run([{1: told(mode="yielded")}, {}, {}, {1: told(mode="holding")}, {}], events))
    ]
    assert told_of == ["yielded", "full", "holding"]


def test_of_too_many_the_gravest_are_shown_in_the_order_of_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(content, "MOST_FAULTS", 2)
    events = [
        Event(source="ground", tick=tick, level="error" if tick else "warning", kind="disk", text=str(tick))
        for tick in range(3)
    ]
    rows, more = fault_rows(run([{}], events))
    assert [row.text for row in rows] == ["1", "2"]
    assert more == 1


def test_spells_end_with_the_first_tick_without_and_the_last_at_the_last_tick() -> None:
    time_s = np.arange(6.0)
    holds = np.array([True, False, True, True, False, True])
    assert [(spell.start_s, spell.end_s) for spell in spells(time_s, holds)] == [(0, 1), (2, 4), (5, 5)]
    assert [(spell.first, spell.behind) for spell in spells(time_s, holds, bridged_s=1.0)] == [(0, 6)]
    assert spells(time_s, np.zeros(6, bool)) == []
