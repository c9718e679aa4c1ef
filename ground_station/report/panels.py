"""Which drawings the report has, and why one that it lacks is missing."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ground_station.report import content, figures, flight_figures
from ground_station.report.run_data import Flight, Run

NO_FLIGHT = "No trajectories were recorded."


@dataclass(frozen=True, slots=True)
class Panel:
    """A drawing, or the reason why there is none."""

    title: str
    svg: str | None
    missing: str = ""
    shape: Literal["", "tall", "wide"] = ""
    """Rows or columns of the page that it takes, more than one."""
    note: str = ""


def panels(run: Run) -> Iterator[Panel]:
    yield from _of_the_mission(run)
    if run.flight is None or not len(run.flight.time_s):
        yield Panel("Flight", None, NO_FLIGHT)
    else:
        yield from _of_the_flight(run, run.flight)


def _of_the_mission(run: Run) -> Iterator[Panel]:
    curves, mission = run.curves, run.mission
    nothing = "No metrics were recorded."
    recorded = len(curves.get("time_s", ())) > 0
    yield Panel("Importance", figures.importance(curves, mission) if recorded else None, nothing)

    scored = recorded and bool(np.isfinite(curves["f_score_visible"]).any())
    svg = figures.f_scores(curves, content.floor_scores(run)) if scored else None
    yield Panel("Quality of the map", svg, "No F-score: the run had no map or no truth to compare it with.")

    drones = sorted(drone.id for drone in mission.drones)
    apart = recorded and bool(np.isfinite(curves["min_separation_m"]).any())
    svg = figures.separation(curves, drones, mission.flight.separation_m) if apart else None
    yield Panel("Separation", svg, "One drone: nobody to keep apart from." if len(drones) == 1 else nothing)


def _of_the_flight(run: Run, flight: Flight) -> Iterator[Panel]:
    mission = run.mission
    yield Panel("Paths from above", flight_figures.paths(flight, mission), shape="tall")
    yield Panel("Height", flight_figures.heights(flight, mission))

    kept = bool(np.isfinite(flight.region_margin_m).any())
    yield Panel(
        "Constraint margins",
        flight_figures.margins(flight, mission) if kept else None,
        "No margins were recorded.",
        shape="tall" if kept else "",
        note="The smallest barrier b ≥ 0 of each kind that a drone’s controller keeps to, on its predicted pose."
        " That of obstacles falls below 0 where the map has just learned of something beside a drone.",
    )
    solved = bool((flight.solve_time_s > 0).any())
    nothing = "No solve times were recorded."
    over_time = flight_figures.solve_times_over_time(flight, mission.tick_s) if solved else None
    yield Panel("Quadratic program over time", over_time, nothing)
    yield Panel("Quadratic program", flight_figures.solve_times(flight, mission.tick_s) if solved else None, nothing)

    told = bool((flight.mode != "").any())
    yield Panel("Modes", flight_figures.modes(flight) if told else None, "No modes were recorded.", shape="wide")
