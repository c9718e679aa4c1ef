"""The maps that a study made after its flights, and what they come to over its rooms."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from ground_station.study.flown import Measure
from ground_station.study.plan_file import FIGURES_FILE, MAPS_FOLDER, Plan, PlannedMap
from ground_station.study.statistics import Spread, spread_of
from protocol.errors import StorageError

MEASURES: Final = (
    Measure("f_visible", "F visible", 3),
    Measure("f_objects", "F objects", 3),
    Measure("f_exposed", "F exposed", 3),
    Measure("precision", "precision", 3),
    Measure("recall", "recall", 3),
    Measure("chamfer_cm", "Chamfer [cm]", 2),
    Measure("keyframes", "keyframes", 0),
    Measure("cpu_ms", "ms per keyframe", 1),
)
"""What a map comes to. Precision and recall are of the visible surface; milliseconds of processor time."""
FLOOR: Final = "a bare floor"
"""The way that any map must beat."""


@dataclass(frozen=True, slots=True)
class Mapped:
    planned: PlannedMap
    figures: Mapping[str, float]
    """By the keys of `MEASURES`; NaN where there is none."""
    floor: Mapping[str, float]
    """The same of a bare floor, as far as it has them."""
    reason: str
    """Why there is no map; empty if there is one."""
    folder: Path


@dataclass(frozen=True, slots=True)
class LevelRow:
    """One way of making maps, under one texture."""

    contrast: float
    way: str
    spreads: Mapping[str, Spread]
    """Over the rooms, by the keys of `MEASURES`."""
    reasons: tuple[str, ...]
    """Why rooms have no map, each once."""


def load_mapped(folder: Path, plan: Plan) -> list[Mapped]:
    """All maps of ``plan`` that are made by now, in its order. Raises `StorageError` where one cannot be read."""
    found = []
    for planned in plan.maps:
        place = folder / MAPS_FOLDER / planned.folder
        if place.is_dir():
            found.append(_mapped(planned, place))
    return found


def level_rows(maps: Sequence[Mapped]) -> list[LevelRow]:
    """Highest contrast first; a bare floor, then the ways in the order of the plan."""
    rows = []
    for contrast in sorted({each.planned.flight.contrast for each in maps}, reverse=True):
        chosen = [each for each in maps if each.planned.flight.contrast == contrast]
        floors = {each.planned.flight.seed: each.floor for each in chosen if not each.reason}
        if floors:
            rows.append(LevelRow(contrast, FLOOR, _spreads(list(floors.values())), ()))
        for way in dict.fromkeys(each.planned.way for each in chosen):
            own = [each for each in chosen if each.planned.way == way]
            reasons = tuple(dict.fromkeys(each.reason for each in own if each.reason))
            rows.append(LevelRow(contrast, way, _spreads([each.figures for each in own]), reasons))
    return rows


def _spreads(figures: Sequence[Mapping[str, float]]) -> dict[str, Spread]:
    return {measure.key: spread_of([each[measure.key] for each in figures]) for measure in MEASURES}


def _mapped(planned: PlannedMap, folder: Path) -> Mapped:
    path = folder / FIGURES_FILE
    try:
        told: dict[str, Any] = json.loads(path.read_bytes())
        if "reason" in told:
            return Mapped(planned, _scores({}), _scores({}), str(told["reason"]), folder)
        more = {
            "chamfer_cm": 100 * float(told["chamfer_m"]),
            "keyframes": float(told["keyframes"]),
            "cpu_ms": float(told["cpu_ms_per_keyframe"]),
        }
        return Mapped(planned, _scores(told) | more, _scores(told["floor"]), "", folder)
    except OSError as error:
        raise StorageError(f"{path}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise StorageError(f"{path}: damaged: {error}") from error


def _scores(told: Mapping[str, Any]) -> dict[str, float]:
    """Of what an evaluation says in JSON."""
    figures = {measure.key: math.nan for measure in MEASURES}
    for surface in ("visible", "objects", "exposed"):
        if surface in told:
            figures[f"f_{surface}"] = float(told[surface]["f"])
    if "visible" in told:
        figures |= {name: float(told["visible"][name]) for name in ("precision", "recall")}
    return figures
