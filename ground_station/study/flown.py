"""One flight of a study, reduced to its curves and its figures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from ground_station.report.run_data import Curves, Mesh, Run
from ground_station.report.run_folder import load_run
from ground_station.study.plan_file import FLIGHTS_FOLDER, Plan, PlannedFlight, Series
from protocol.geometry import Floats

LEVELS: Final = (0.75, 0.5, 0.25)
"""Of J, whose first time is told."""


@dataclass(frozen=True, slots=True)
class Measure:
    key: str
    title: str
    """Heading of its column, with its unit."""
    decimals: int


MEASURES: Final = (
    Measure("f_visible", "F visible", 3),
    Measure("f_objects", "F objects", 3),
    Measure("f_exposed", "F exposed", 3),
    Measure("precision", "precision", 3),
    Measure("recall", "recall", 3),
    *(Measure(f"time_to_{level:g}_s", f"J = {level:g} [s]", 0) for level in LEVELS),
    Measure("path_m", "path [m]", 0),
    Measure("separation_m", "smallest separation [m]", 3),
    Measure("update_s", "feedback update [s]", 4),
)
"""What a flight comes to. Precision and recall are of the visible surface; the path is all drones' together."""


@dataclass(frozen=True, slots=True)
class Flown:
    planned: PlannedFlight
    curves: Curves
    """Columns of metrics.csv; F-scores repeat the newest, and are NaN before the first."""
    figures: Mapping[str, float]
    """By the keys of `MEASURES`; NaN for what the flight does not have."""
    folder: Path

    def at(self, column: str, time_s: float) -> float:
        """The newest value of a curve at a mission time; NaN if there is none yet."""
        until = self.curves["time_s"] <= time_s
        return float(self.curves[column][until][-1]) if until.any() else math.nan

    def points(self, column: str) -> tuple[Floats, Floats]:
        """Mission time and value of the rows that say something new of a curve, (n,) each."""
        values = self.curves[column]
        fresh = np.isfinite(values) & (np.diff(values, prepend=np.nan) != 0)
        return self.curves["time_s"][fresh], values[fresh]

    def mesh(self) -> Mesh | None:
        """Read anew each time: a study has more of them than should be in memory."""
        return load_run(self.folder).mesh


def load_flown(folder: Path, plan: Plan) -> list[Flown]:
    """All flights of ``plan`` that are flown by now, in its order. Raises `CovreconError` where one cannot be read."""
    found = []
    for planned in plan.flights:
        place = folder / FLIGHTS_FOLDER / planned.folder
        if place.is_dir():
            run = load_run(place)
            found.append(Flown(planned, run.curves, figures_of(run), place))
    return found


def by_series(flights: Sequence[Flown]) -> dict[Series, list[Flown]]:
    """In the order of the flights."""
    grouped: dict[Series, list[Flown]] = {}
    for flown in flights:
        grouped.setdefault(flown.planned.series, []).append(flown)
    return grouped


def figures_of(run: Run) -> dict[str, float]:
    summary: Mapping[str, Any] = run.summary or {}

    def told(name: str) -> float:
        value = summary.get(name)
        return math.nan if value is None else float(value)

    time_s, importance = run.curves["time_s"], run.curves["importance"]
    return {
        "f_visible": told("f_score_visible"),
        "f_objects": told("f_score_objects"),
        "f_exposed": told("f_score_exposed"),
        "precision": told("precision_visible"),
        "recall": told("recall_visible"),
        **{f"time_to_{level:g}_s": time_to(time_s, importance, level) for level in LEVELS},
        "path_m": path_length(run.flight.poses) if run.flight else math.nan,
        "separation_m": told("min_separation_m"),
        "update_s": told("feedback_update_s"),
    }


def time_to(time_s: Floats, importance: Floats, level: float) -> float:
    """Mission time at which J is first at or below ``level``, to a row of metrics.csv; NaN if it never is."""
    reached = np.flatnonzero(importance <= level)
    return float(time_s[reached[0]]) if len(reached) else math.nan


def path_length(poses: Floats) -> float:
    """Metres that all drones flew together, of poses (T, D, 5).

    Ticks in which a drone was not heard are passed over.
    """
    total = 0.0
    for drone in range(poses.shape[1]):
        positions = poses[:, drone, :3]
        heard = positions[np.isfinite(positions).all(axis=1)]
        total += float(np.linalg.norm(np.diff(heard, axis=0), axis=1).sum())
    return total
