"""What went wrong in a flight, as rows in the order of time: a pure function of a run.

Found in what the drones told of themselves at every tick, and in the events that processes announced.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ground_station.report.run_data import Flight, Run
from ground_station.report.spells import Spell, spells
from protocol.geometry import Floats
from protocol.mission import Flight as FlightSettings
from protocol.separation import SIGMAS

Severity = Literal["note", "warning", "error"]
SEVERITIES: tuple[Severity, ...] = ("note", "warning", "error")
BRIDGED_S = 1.0
"""Spells of the same kind that are no further apart are told as one."""
SILENT_S = 0.5
"""A drone that is not heard for longer is told of; less is a lost message."""
BROKEN = -1e-6
"""A barrier below it was broken; above it, rounding."""
COVERING = ("flying", "braking", "joining")
"""When no drone does any of it any more, the mission is over."""
ROUTINE = ("", "starting", "flying", "braking")
"""Modes that are no news; braking is told with its reason."""
SEVERITY_OF_MODE: dict[str, Severity] = {"yielded": "error", "landed": "note"}
BARRIERS: tuple[tuple[str, str, str, Severity], ...] = (
    ("inside the separation as lag and late commands widen it", "m²", "separation_margin_m2", "warning"),
    ("barrier of the flight region broken", "m", "region_margin_m", "error"),
    ("barrier of the camera pitch broken", "rad²", "pitch_margin_rad2", "error"),
    ("nearer than its margin to what was not seen free", "m", "obstacle_margin_m", "note"),
)
"""What it means that one is below zero. The separation's is wider than the distance that must be kept, by what a
vehicle may fly on until a command works. The obstacles' falls when the map learns of something beside a drone."""
GROWN = "inside the flight region's margin, which grew with what its place may be off"


@dataclass(frozen=True, slots=True)
class Fault:
    start_s: float
    end_s: float
    """The same as ``start_s`` for what has no duration."""
    source: str
    """Role of the process: "drone/3", "ground"."""
    text: str
    severity: Severity


def faults(run: Run) -> list[Fault]:
    """Those of all drones and processes, the earliest first."""
    found = []
    for event in run.history.events:
        if event.level != "info":
            time_s = event.tick * run.mission.tick_s
            found.append(Fault(time_s, time_s, event.source, event.text, event.level))
    if run.flight is not None and len(run.flight.time_s):
        for index, drone in enumerate(run.flight.drones.tolist()):
            found += _of_drone(run.flight, index, f"drone/{drone}", run.mission.flight)
    return sorted(found, key=lambda fault: (fault.start_s, fault.source, fault.text))


def _of_drone(flight: Flight, index: int, source: str, settings: FlightSettings) -> Iterator[Fault]:
    time_s, mode, fallback = flight.time_s, flight.mode[:, index], flight.fallback[:, index]

    for spell in spells(time_s, fallback != "", BRIDGED_S):
        reasons = Counter(fallback[spell.first : spell.behind].tolist())
        del reasons[""]
        counts = ", ".join(f"{reason.replace('_', ' ')} {count:,}" for reason, count in sorted(reasons.items()))
        yield _fault(spell, source, f"braked for {_ticks(reasons.total())}: {counts}", "warning")

    covering = np.flatnonzero(np.isin(flight.mode, COVERING).any(axis=1))
    over = covering[-1] if len(covering) else -1
    for name in sorted(set(mode.tolist()) - set(ROUTINE)):
        for spell in spells(time_s, mode == name):
            if spell.first <= over:
                yield _fault(spell, source, name, SEVERITY_OF_MODE.get(name, "warning"))

    heard = np.isfinite(flight.poses[:, index, 0])
    ever = np.flatnonzero(heard)
    silent = ~heard & (np.arange(len(heard)) >= (ever[0] if len(ever) else len(heard)))
    for spell in spells(time_s, silent):
        if spell.end_s - spell.start_s >= SILENT_S:
            yield _fault(spell, source, "not heard", "error")

    told = SIGMAS * np.nan_to_num(flight.position_sd_m[:, index]) - settings.position_error_m
    grown = np.where(told > 0, told, 0.0)  # by so much the region's margin is more than the mission says
    region = flight.region_margin_m[:, index]
    for meaning, unit, column, severity in BARRIERS:
        margin = region + grown if column == "region_margin_m" else getattr(flight, column)[:, index]
        yield from _broken(time_s, margin, margin < BROKEN, source, (meaning, unit, severity))
    only_grown = (region < BROKEN) & (region + grown >= BROKEN)
    yield from _broken(time_s, region, only_grown, source, (GROWN, "m", "warning"))

    others = np.delete(flight.poses[:, :, :3], index, axis=1)
    distances = np.linalg.norm(others - flight.poses[:, index, None, :3], axis=2)
    nearest = np.fmin.reduce(distances, axis=1, initial=np.inf)
    limit_m = settings.separation_m
    for spell in spells(time_s, nearest < limit_m, BRIDGED_S):
        closest = np.nanmin(nearest[spell.first : spell.behind])
        yield _fault(spell, source, f"{closest:.3f} m from another drone, less than {limit_m:g} m", "error")


def _broken(
    time_s: Floats, margin: Floats, below: NDArray[np.bool_], source: str, told: tuple[str, str, Severity]
) -> Iterator[Fault]:
    """``told``: what it means, the margin's unit, and how bad it is."""
    meaning, unit, severity = told
    for spell in spells(time_s, below, BRIDGED_S):
        worst = np.nanmin(margin[spell.first : spell.behind])
        yield _fault(spell, source, f"{meaning}, {worst:.3g} {unit} at worst", severity)


def _fault(spell: Spell, source: str, text: str, severity: Severity) -> Fault:
    return Fault(spell.start_s, spell.end_s, source, text, severity)


def _ticks(count: int) -> str:
    return f"{count:,} tick{'' if count == 1 else 's'}"
