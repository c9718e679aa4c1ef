"""How far a study is, in words, and when it will be done."""

from __future__ import annotations

import io
import math

import pytest
from rich.console import Console

from deploy.bench.progress import LiveWatch, PlainWatch, Tally, duration_text
from ground_station.study.plan_file import PlannedFlight

FLIGHTS = [
    PlannedFlight(method="grid", drones=drones, threshold=0.5, scene="room", seed=1, key=f"{drones}" * 64)
    for drones in (4, 1, 1, 1)
]
FLIGHTS = [flight.model_copy(update={"seed": seed}) for seed, flight in enumerate(FLIGHTS)]
NAMES = [flight.name for flight in FLIGHTS]


def a_tally() -> Tally:
    """Of four flights the last is flown; the first takes as long as the others together."""
    return Tally.of(FLIGHTS, FLIGHTS[:3], duration_s=100.0)


def test_the_rest_is_told_by_the_pace_so_far() -> None:
    tally = a_tally()
    assert math.isnan(tally.rest_s(10.0))
    tally.began(NAMES[0])
    tally.shares[NAMES[0]] = 0.5  # 300 of 1200
    assert tally.rest_s(30.0) == pytest.approx(90.0)
    tally.ended(NAMES[0], well=True)
    assert tally.rest_s(60.0) == pytest.approx(60.0)
    for name in NAMES[1:3]:
        tally.began(name)
        tally.ended(name, well=True)
    assert tally.rest_s(120.0) == 0.0
    assert tally.flown == tally.total == 4


def test_a_flight_that_failed_is_not_flown() -> None:
    tally = a_tally()
    tally.began(NAMES[1])
    tally.ended(NAMES[1], well=False)
    assert (tally.flown, NAMES[1] in tally.left) == (1, False)


def test_without_a_terminal_each_flight_that_ended_is_a_line_and_the_rest_another() -> None:
    said: list[str] = []
    instants = iter([0.0, 1.0, 61.0, 61.0, 120.0])
    with PlainWatch(a_tally(), said.append, lambda: next(instants)) as watch:
        watch.began(NAMES[0])
        watch.flown({NAMES[0]: 0.1})
        assert said == []
        watch.flown({NAMES[0]: 0.2})
        watch.ended(NAMES[0], "J 0.2, 60 s", well=True)
    assert said[-2:] == [f"{NAMES[0]}: J 0.2, 60 s", "2 of 4 flights flown, 0 flying, about 2 min left"]
    assert said[0].startswith("1 of 4 flights flown, 1 flying, about ")


def test_on_a_terminal_each_flight_that_flies_has_a_bar() -> None:
    text = io.StringIO()
    console = Console(file=text, force_terminal=True, width=120)
    with LiveWatch(a_tally(), console) as watch:
        watch.began(NAMES[0])
        watch.began(NAMES[1])
        watch.flown({NAMES[0]: 0.5})
        watch.ended(NAMES[1], "J 0.2, 60 s", well=True)
    assert f"{NAMES[1]}: J 0.2, 60 s" in text.getvalue()
    assert "2 of 4 flights flown, 1 flying" in text.getvalue()


@pytest.mark.parametrize(("seconds", "said"), [(0.0, "0 min"), (61.0, "2 min"), (3600.0, "1 h 0 min")])
def test_durations_are_told_in_minutes(seconds: float, said: str) -> None:
    assert duration_text(seconds) == said
