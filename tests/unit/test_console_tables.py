"""What the console shows in curves, tables and lists."""

import math

import numpy as np
import pytest

from ground_station.console.constraints import all_in_words, in_words
from ground_station.console.events import SEVERITY, EventFilter, EventList, Level
from ground_station.console.fleet import SEVERITIES, Severity, fleet_row
from ground_station.console.history import History
from protocol.messages import Control, DroneState, Event, Mode, ReplicaState
from protocol.vehicle_settings import Vehicles

CONTROL = Control(
    tick=9,
    outcome="solved",
    velocity=(0.0,) * 5,
    slack=-1.5,
    sampling=1.0,
    solve_s=0.002,
    separation_margin_m2=0.34,
    region_margin_m=1.2,
    pitch_margin_rad2=0.05,
    active=("separation:2", "region:+x"),
    fallbacks=3,
    refused=0,
)


def state(mode: Mode = "flying", battery: float = 0.9, missing: int = 0, **control: object) -> DroneState:
    return DroneState(
        drone=2,
        tick=10,
        pose=(0.0,) * 5,
        velocity=(0.0,) * 5,
        battery=battery,
        mode=mode,
        importance=0.5,
        replica=ReplicaState(tick=0, epoch=1, next_jump=0, missing=missing, repaired=0, lost=0),
        control=CONTROL.model_copy(update=control),
    )


def test_a_short_history_is_kept_as_it_is() -> None:
    history = History(2)
    for k in range(50):
        assert history.add(0.5 * k, (k, -k))
    time_s, up, down = history.curves
    np.testing.assert_array_equal(time_s, 0.5 * np.arange(50))
    np.testing.assert_array_equal(up, np.arange(50))
    np.testing.assert_array_equal(down, -np.arange(50))


def test_a_long_history_is_coarser_but_whole() -> None:
    history = History(1, capacity=100)
    for k in range(123_457):
        history.add(float(k), (math.sin(k / 2e4),))
        if k % 10_000 == 0:
            assert history.curves[0][-1] == k
    time_s, values = history.curves
    assert 40 <= len(time_s) <= 101
    assert (time_s[0], time_s[-1]) == (0, 123_456)
    np.testing.assert_allclose(values, np.sin(time_s / 2e4))
    steps = np.diff(time_s)
    assert steps[:-1].max() <= 2 * steps[:-1].min()


def test_a_sample_that_is_not_later_is_left_out() -> None:
    history = History(1)
    assert history.add(1.0, (1.0,))
    assert not history.add(1.0, (2.0,))
    assert not history.add(0.5, (2.0,))
    assert not history.add(math.nan, (2.0,))
    assert [curve.tolist() for curve in history.curves] == [[1.0], [1.0]]


def test_no_samples_make_empty_curves() -> None:
    assert [curve.shape for curve in History(3).curves] == [(0,)] * 4


@pytest.mark.parametrize("capacity", [0, 1, 7])
def test_a_history_that_cannot_be_halved_is_refused(capacity: int) -> None:
    with pytest.raises(ValueError, match="cannot be halved"):
        History(1, capacity)


def test_a_healthy_drone_is_good() -> None:
    row = fleet_row(2, state(), 0.04, alive=True)
    assert (row.severity, row.reasons, row.mode) == ("good", (), "flying")
    assert (row.battery, row.slack, row.fallbacks, row.solve_ms) == (0.9, -1.5, 3, 2.0)
    assert row.active == "distance to drone 2, edge of the region (+x)"
    assert row.separation_margin_m2 == 0.34


@pytest.mark.parametrize(
    ("heard", "link_age_s", "alive", "severity", "reason"),
    [
        (state("braking", outcome="infeasible"), 0.0, True, "warning", "solver: infeasible"),
        (state("yielded"), 0.0, True, "warning", "a pilot or the autopilot flies it"),
        (state("landing"), 0.0, True, "notice", "comes down"),
        (state(battery=0.25), 0.0, True, "warning", "battery low"),
        (state(battery=0.05), 0.0, True, "bad", "battery critical"),
        (state(), 3.4, True, "warning", "not heard for 3 s"),
        (state(), 0.1, False, "bad", "its process is gone"),
        (state(missing=4), 0.0, True, "notice", "its importance is not complete"),
        (state(separation_margin_m2=-0.1), 0.0, True, "bad", "closer to another than allowed"),
        (state(region_margin_m=-0.1), 0.0, True, "warning", "outside the flight region"),
        (
            state(region_margin_m=-0.1).model_copy(update={"position_sd_m": 0.05}),
            0.0,
            True,
            "notice",
            "too unsure of its place for where it is in the flight region",
        ),
        (state(obstacle_margin_m=-0.1), 0.0, True, "notice", "leaves what its map has learned of"),
        (state(pitch_margin_rad2=-0.1), 0.0, True, "warning", "camera outside its range"),
        (state(telemetry_age_s=0.8), 0.0, True, "warning", "telemetry 0.8 s old"),
        (state().model_copy(update={"blind_s": 0.5}), 0.0, True, "warning", "its vehicle is not heard"),
    ],
)
def test_what_is_wrong_is_said(
    heard: DroneState, link_age_s: float, alive: bool, severity: Severity, reason: str
) -> None:
    row = fleet_row(2, heard, link_age_s, alive)
    assert row.severity == severity
    assert reason in row.reasons


def test_the_worst_comes_first() -> None:
    row = fleet_row(2, state("holding", battery=0.2, separation_margin_m2=-1.0), 0.0, alive=True)
    assert row.reasons == ("closer to another than allowed", "battery low", "holds its place")
    assert SEVERITIES.index(row.severity) == 3


def test_the_missions_battery_limits_count() -> None:
    row = fleet_row(2, state(battery=0.35), 0.0, alive=True, vehicles=Vehicles(battery_low=0.4))
    assert row.severity == "warning"


def test_a_drone_that_was_never_heard_waits() -> None:
    row = fleet_row(7, None, None, alive=False)
    assert (row.drone, row.mode, row.severity, row.battery) == (7, "waiting", "notice", None)
    assert fleet_row(7, None, None, alive=True).reasons != row.reasons


def test_a_drone_that_has_landed_may_leave() -> None:
    assert fleet_row(2, state("landed"), 60.0, alive=False).severity == "notice"
    assert fleet_row(2, state("landed"), 60.0, alive=False).mode == "landed"
    assert fleet_row(2, state("flying"), 60.0, alive=False).mode == "lost"


def test_a_simulated_drone_that_ends_with_its_mission_is_not_lost_but_a_real_one_in_the_air_is() -> None:
    ended = fleet_row(2, state("returning"), 60.0, alive=False, finished=True)
    real = fleet_row(2, state("returning"), 60.0, False, Vehicles(kind="px4"), finished=True)

    assert (ended.mode, ended.severity) == ("ended", "notice")
    assert (real.mode, real.severity) == ("lost", "bad")


def test_a_lone_drone_has_no_separation_and_one_without_a_decision_no_figures() -> None:
    assert fleet_row(2, state(separation_margin_m2=1e9), 0.0, alive=True).separation_margin_m2 is None
    undecided = fleet_row(2, state().model_copy(update={"control": None}), 0.0, alive=True)
    assert (undecided.slack, undecided.solve_ms, undecided.active) == (None, None, "")


def test_every_row_of_the_program_has_words() -> None:
    assert in_words("separation:12") == "distance to drone 12"
    assert in_words("region:-z") == "edge of the region (-z)"
    assert in_words("pitch") == "range of the gimbal"
    assert all_in_words(["bound:yaw", "bound:pitch", "bound:z"]) == (
        "turn rate limit, tilt rate limit, speed limit along z"
    )
    assert in_words("bound:<b>") == "bound:<b>"
    assert all_in_words([]) == ""


def event(number: int, level: Level = "info", source: str = "ground", kind: str = "mode") -> Event:
    return Event(source=source, tick=number, level=level, kind=kind, text=f"Event {number}")


def test_events_come_newest_first() -> None:
    events = EventList()
    for number in range(5):
        events.add(event(number, "error" if number == 1 else "info"))
    assert [shown.tick for shown in events.newest()] == [4, 3, 2, 1, 0]
    assert [shown.tick for shown in events.newest(2)] == [4, 3]


def test_many_small_events_do_not_drive_out_an_error() -> None:
    events = EventList(capacity=10)
    events.add(event(0, "error"))
    for number in range(1, 1000):
        events.add(event(number))
    assert events.heard == 1000
    shown = events.newest(100)
    assert len(shown) == 11
    assert shown[-1].level == "error"


@pytest.mark.parametrize(
    ("chosen", "ticks"),
    [
        (EventFilter(), [3, 2, 1, 0]),
        (EventFilter(level="warning"), [3, 1]),
        (EventFilter(level="error"), [3]),
        (EventFilter(source="drone/2"), [2, 1]),
        (EventFilter(kind="map"), [3]),
        (EventFilter(text="EVENT 2"), [2]),
        (EventFilter(level="warning", source="drone/2"), [1]),
        (EventFilter(text="nothing"), []),
    ],
)
def test_a_filter_shows_what_all_of_its_parts_let_through(chosen: EventFilter, ticks: list[int]) -> None:
    events = EventList()
    events.add(event(0))
    events.add(event(1, "warning", "drone/2"))
    events.add(event(2, "info", "drone/2"))
    events.add(event(3, "error", kind="map"))
    assert [shown.tick for shown in events.newest(chosen=chosen)] == ticks


def test_there_is_something_to_filter_by() -> None:
    events = EventList()
    for source, kind in (("ground", "map"), ("drone/2", "mode"), ("drone/1", "mode")):
        events.add(event(1, source=source, kind=kind))
    assert events.sources == ("drone/1", "drone/2", "ground")
    assert events.kinds == ("map", "mode")
    assert list(SEVERITY) == ["info", "warning", "error"]
