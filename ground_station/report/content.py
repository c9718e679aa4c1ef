"""What the report says, as text and rows: pure functions of a run."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ground_station.palette import drone_colour
from ground_station.report.faults import SEVERITIES, Severity, faults
from ground_station.report.run_data import Flight, Run

UNKNOWN = "–"
MOST_FAULTS = 100
"""Rows that are shown."""
SURFACES = ("visible", "exposed", "objects")
State = Literal["", "good", "bad"]


@dataclass(frozen=True, slots=True)
class Kpi:
    label: str
    value: str
    note: str
    state: State = ""


@dataclass(frozen=True, slots=True)
class ScoreRow:
    """F, precision and recall of one kind of surface, and the bare floor's F."""

    surface: str
    f: str
    precision: str
    recall: str
    floor_f: str


@dataclass(frozen=True, slots=True)
class DroneRow:
    drone: int
    colour: str
    path: str
    nearest: str
    solve_median: str
    solve_p99: str
    solve_longest: str
    slack: str
    fallbacks: str
    """How many ticks, and for which reasons."""
    battery: str
    """At the end, in percent."""
    contacts: str
    """With the scene."""


@dataclass(frozen=True, slots=True)
class FaultRow:
    time: str
    duration: str
    source: str
    text: str
    severity: Severity


def number(value: float, decimals: int, unit: str = "") -> str:
    return f"{value:,.{decimals}f}{unit}" if math.isfinite(value) else UNKNOWN


def figure(run: Run, key: str, column: str) -> float:
    """From the summary, or from the newest row of a run that was cut short; NaN if neither knows."""
    if run.summary is None:
        return run.last(column)
    value = run.summary.get(key)
    return math.nan if value is None else float(value)


def floor_scores(run: Run) -> Mapping[str, float]:
    """F of a bare floor by surface; empty without truth."""
    floor = (run.summary or {}).get("floor_baseline", {})
    return {name: floor[f"f_score_{name}"] for name in SURFACES if floor.get(f"f_score_{name}") is not None}


def kpis(run: Run) -> list[Kpi]:
    jumps, keyframes = figure(run, "jumps", "jumps"), figure(run, "keyframes", "keyframes")
    method, backend = run.mission.feedback.method, run.mission.reconstruction.backend
    return [
        Kpi("Importance J", number(figure(run, "J", "importance"), 3), _threshold_note(run)),
        *(_score_kpi(run, name) for name in SURFACES),
        _separation_kpi(run),
        *_contacts_kpi(run),
        Kpi("Jumps", number(jumps, 0), "no feedback" if method == "none" else f"{method} feedback"),
        Kpi("Keyframes", number(keyframes, 0), "no reconstruction" if backend == "none" else backend.replace("_", " ")),
        *_time_kpis(run),
    ]


def _score_kpi(run: Run, surface: str) -> Kpi:
    value, floor = figure(run, f"f_score_{surface}", f"f_score_{surface}"), floor_scores(run).get(surface, math.nan)
    state: State = ""
    if math.isfinite(value) and math.isfinite(floor):
        state = "good" if value > floor else "bad"
    if math.isfinite(floor):
        note = f"bare floor {floor:.3f}"
    else:
        note = "bare floor not recorded" if math.isfinite(value) else "no map or no truth"
    return Kpi(f"F-score, {surface}", number(value, 3), note, state)


def _separation_kpi(run: Run) -> Kpi:
    approaches = run.curves.get("min_separation_m", np.empty(0))
    approaches = approaches[np.isfinite(approaches)]
    if run.summary is not None:
        nearest = figure(run, "min_separation_m", "min_separation_m")
    else:
        nearest = float(approaches.min()) if len(approaches) else math.nan
    limit = run.mission.flight.separation_m
    if not math.isfinite(nearest):
        return Kpi("Nearest approach", UNKNOWN, "one drone" if len(run.mission.drones) == 1 else "not recorded")
    return Kpi(
        "Nearest approach", number(nearest, 3, " m"), f"limit {limit:g} m", "good" if nearest >= limit else "bad"
    )


def _contacts(run: Run) -> Mapping[str, int] | None:
    """By drone; None where nobody counted, and in summaries that were written before anybody did."""
    contacts: Mapping[str, int] | None = (run.summary or {}).get("contacts")
    return contacts


def _contacts_kpi(run: Run) -> Iterator[Kpi]:
    contacts = _contacts(run)
    if contacts is not None:
        count = sum(contacts.values())
        touched = ", ".join(drone for drone, times in contacts.items() if times)
        note = f"of drones {touched}" if touched else "of no drone"
        yield Kpi("Contacts with the scene", f"{count:,}", note, "bad" if count else "good")


def _time_kpis(run: Run) -> Iterator[Kpi]:
    flown, wall = figure(run, "sim_time_s", "time_s"), float((run.summary or {}).get("wall_time_s", math.nan))
    yield Kpi("Mission time", number(flown, 1, " s"), f"at most {run.mission.duration_s:,.0f} s")
    speed = flown / wall if wall > 0 else math.nan
    yield Kpi("Wall time", number(wall, 1, " s"), "" if math.isfinite(wall) else "not recorded")
    yield Kpi("Speed", number(speed, 1, " ×"), "mission time / wall time")


def _threshold_note(run: Run) -> str:
    importance = run.curves.get("importance", np.empty(0))
    threshold = run.mission.feedback.threshold
    if run.mission.feedback.method == "none" or not len(importance):
        return "1 at the start"
    below = run.curves["time_s"][importance < threshold]
    return f"below J_th = {threshold:g} after {below[0]:,.0f} s" if len(below) else f"never below J_th = {threshold:g}"


def score_rows(run: Run) -> list[ScoreRow]:
    """Empty without scores."""
    summary = run.summary or {}
    if summary.get("f_score_visible") is None:
        return []
    floor = floor_scores(run)
    return [
        ScoreRow(
            surface=name,
            f=number(float(summary[f"f_score_{name}"]), 3),
            precision=number(float(summary[f"precision_{name}"]), 3),
            recall=number(float(summary[f"recall_{name}"]), 3),
            floor_f=number(floor.get(name, math.nan), 3),
        )
        for name in SURFACES
    ]


def drone_rows(run: Run) -> list[DroneRow]:
    """One row a drone, from the recorded flight; empty if none was recorded."""
    return [] if run.flight is None else [_drone_row(run, run.flight, index) for index in range(len(run.flight.drones))]


def _drone_row(run: Run, flight: Flight, index: int) -> DroneRow:
    drone = int(flight.drones[index])
    path = flight.poses[:, index, :3]
    path = path[np.isfinite(path[:, 0])]
    solve_ms = 1e3 * flight.solve_time_s[np.isfinite(flight.solve_time_s[:, index]), index]
    slack = np.abs(flight.slack[np.isfinite(flight.slack[:, index]), index])
    distance = run.curves.get(f"separation_{drone}_m", np.empty(0))
    distance = distance[np.isfinite(distance)]
    battery = flight.battery[np.isfinite(flight.battery[:, index]), index]
    contacts = _contacts(run)
    reasons = Counter(reason for reason in flight.fallback[:, index].tolist() if reason)
    named = ", ".join(f"{reason} {count:,}" for reason, count in sorted(reasons.items()))
    return DroneRow(
        drone=drone,
        colour=drone_colour(index),
        path=number(float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()), 1),
        nearest=number(float(distance.min()) if len(distance) else math.nan, 3),
        solve_median=number(float(np.median(solve_ms)) if len(solve_ms) else math.nan, 2),
        solve_p99=number(float(np.percentile(solve_ms, 99)) if len(solve_ms) else math.nan, 2),
        solve_longest=number(float(solve_ms.max()) if len(solve_ms) else math.nan, 2),
        slack=f"{slack.max():.3g}" if len(slack) else UNKNOWN,
        fallbacks=f"{reasons.total():,} ({named})" if reasons else "0",
        battery=number(100 * float(battery[-1]) if len(battery) else math.nan, 0, " %"),
        contacts=UNKNOWN if contacts is None else f"{contacts.get(str(drone), 0):,}",
    )


def fault_rows(run: Run) -> tuple[list[FaultRow], int]:
    """In the order of time, and how many are left out: of too many the gravest stay."""
    found = faults(run)
    kept = sorted(found, key=lambda fault: -SEVERITIES.index(fault.severity))[:MOST_FAULTS]
    rows = [
        FaultRow(
            time=number(fault.start_s, 1, " s"),
            duration=number(fault.end_s - fault.start_s, 1, " s") if fault.end_s > fault.start_s else "",
            source=fault.source.replace("/", " "),
            text=fault.text,
            severity=fault.severity,
        )
        for fault in sorted(kept, key=found.index)
    ]
    return rows, len(found) - len(rows)


def settings(run: Run) -> list[tuple[str, list[tuple[str, str]]]]:
    """The effective mission as (table, [(key, value)]), in the order of the mission model; "" is the top table."""
    top: list[tuple[str, str]] = []
    tables = []
    for key, value in run.mission.model_dump(mode="json").items():
        if isinstance(value, dict):
            tables.append((key, [(name, _setting(entry)) for name, entry in value.items()]))
        elif key == "drones":
            tables.append((key, [(f"drone {drone['id']} start", _setting(drone["start"])) for drone in value]))
        else:
            top.append((key, _setting(value)))
    return [("", top), *tables]


def _setting(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(_setting(entry) for entry in value)}]"
    if isinstance(value, float):
        return f"{value:.6g}"
    return str(value) if value != "" else '""'
