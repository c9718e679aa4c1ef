"""A study's tables: rows that are the same for CSV and Markdown."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from ground_station.study import paper
from ground_station.study.flown import MEASURES, Flown, by_series
from ground_station.study.plan_file import Method, Series
from ground_station.study.statistics import Difference, Spread, paired_difference, spread_of

UNKNOWN = "–"
PAPER_COLUMNS: Final = {
    "f_visible": "F, paper",
    "time_to_0.25_s": "J = 0.25, paper [s]",
    "update_s": "update, paper [s]",
}
"""Headings of the paper's own figures, each beside the measure that it compares with."""
MOMENTS: Final = {"early": 1 / 3, "middle": 2 / 3, "end": 1.0}
"""At which flights with and without feedback are compared, as shares of their duration."""
SURFACES: Final = {"visible": "f_score_visible", "objects": "f_score_objects"}
"""Whose F is compared, and the columns of metrics.csv that have it."""
BOTH = "all scenes"


@dataclass(frozen=True, slots=True)
class MethodRow:
    series: Series
    spreads: Mapping[str, Spread]
    """By the keys of `MEASURES`."""
    paper: Mapping[str, float]
    """By the same keys, as far as the paper has them."""


@dataclass(frozen=True, slots=True)
class GainRow:
    """F with grid feedback minus F without, at equal flight time."""

    scene: str
    """Or `BOTH`."""
    moment: str
    time_s: float
    without: Mapping[str, Spread]
    """By the keys of `SURFACES`."""
    gains: Mapping[str, Difference]
    """Likewise."""


def method_rows(flights: Sequence[Flown]) -> list[MethodRow]:
    rows = []
    for series, flown in by_series(flights).items():
        spreads = {measure.key: spread_of([flight.figures[measure.key] for flight in flown]) for measure in MEASURES}
        rows.append(MethodRow(series, spreads, _of_the_paper(series)))
    return rows


def _of_the_paper(series: Series) -> dict[str, float]:
    _, method, drones, threshold = series
    if threshold != paper.THRESHOLD:
        return {}
    known = {
        "f_visible": paper.F_SCORE.get((method, drones)),
        "time_to_0.25_s": paper.QUARTER_S.get((method, drones)),
        "update_s": paper.UPDATE_S.get(method) if drones == 1 else None,
    }
    return {key: value for key, value in known.items() if value is not None}


def methods_csv(rows: Sequence[MethodRow]) -> str:
    """Of each measure mean, standard deviation and how many flights have it; empty cells for what there is not."""
    header = ["scene", "method", "drones", "threshold", "flights"]
    for measure in MEASURES:
        header += [measure.key, f"{measure.key}_deviation", f"{measure.key}_known"]
        header += [f"{measure.key}_paper"] if measure.key in PAPER_COLUMNS else []
    lines: list[list[object]] = []
    for row in rows:
        cells: list[object] = [*row.series, row.spreads[MEASURES[0].key].count]
        for measure in MEASURES:
            spread = row.spreads[measure.key]
            cells += [cell(spread.mean), cell(spread.deviation), spread.known]
            cells += [row.paper.get(measure.key, "")] if measure.key in PAPER_COLUMNS else []
        lines.append(cells)
    return csv_text([header, *lines])


def methods_markdown(rows: Sequence[MethodRow]) -> str:
    header = ["method", "flights"]
    for measure in MEASURES:
        header += [measure.title] + ([PAPER_COLUMNS[measure.key]] if measure.key in PAPER_COLUMNS else [])
    lines = []
    for row in rows:
        cells = [paper.label(*row.series[1:]), str(row.spreads[MEASURES[0].key].count)]
        for measure in MEASURES:
            cells.append(spread_text(row.spreads[measure.key], measure.decimals))
            if measure.key in PAPER_COLUMNS:
                cells.append(f"{row.paper[measure.key]:g}" if measure.key in row.paper else "")
        lines.append(cells)
    return markdown([header, *lines])


def orders(rows: Sequence[MethodRow]) -> list[tuple[str, list[Method]]]:
    """The methods flown by one drone from the best F to the worst: by ours, and as the paper reports them."""
    single = [row for row in rows if row.series[2:] == (1, paper.THRESHOLD)]

    def ranked(key: str) -> list[Method]:
        known = [row for row in single if row.spreads[key].known]
        return [row.series[1] for row in sorted(known, key=lambda row: -row.spreads[key].mean)]

    printed = [row for row in single if "f_visible" in row.paper]
    papers = [row.series[1] for row in sorted(printed, key=lambda row: -row.paper["f_visible"])]
    return [("F visible", ranked("f_visible")), ("F objects", ranked("f_objects")), ("paper", papers)]


def gain_rows(flights: Sequence[Flown], duration_s: float) -> list[GainRow]:
    """Of each scene and of all together, pairs by scene and seed; at the end the full score counts, before the live."""
    flown = {(f.planned.scene, f.planned.seed, f.planned.method): f for f in flights}
    pairs = [(each, flown[scene, seed, "grid"]) for (scene, seed, method), each in flown.items()
             if method == "none" and (scene, seed, "grid") in flown]  # fmt: skip
    scenes = list(dict.fromkeys(without.planned.scene for without, _ in pairs))
    rows = []
    for scene in [*scenes, *([BOTH] if len(scenes) > 1 else [])]:
        chosen = [pair for pair in pairs if scene in (pair[0].planned.scene, BOTH)]
        for moment, share in MOMENTS.items():
            time_s = share * duration_s
            values = {
                surface: [tuple(_score_at(f, surface, time_s, duration_s) for f in pair) for pair in chosen]
                for surface in SURFACES
            }
            rows.append(
                GainRow(
                    scene,
                    moment,
                    time_s,
                    without={name: spread_of([pair[0] for pair in found]) for name, found in values.items()},
                    gains={
                        name: paired_difference([pair[0] for pair in found], [pair[1] for pair in found])
                        for name, found in values.items()
                    },
                )
            )
    return rows


def _score_at(flown: Flown, surface: str, time_s: float, duration_s: float) -> float:
    return flown.figures[f"f_{surface}"] if time_s >= duration_s else flown.at(SURFACES[surface], time_s)


def gains_csv(rows: Sequence[GainRow]) -> str:
    header = ["scene", "moment", "time_s", "pairs"]
    for surface in SURFACES:
        header += [f"f_{surface}_none", f"f_{surface}_gain", f"f_{surface}_gain_low", f"f_{surface}_gain_high"]
    lines: list[list[object]] = []
    for row in rows:
        cells: list[object] = [row.scene, row.moment, cell(row.time_s), row.gains["visible"].count]
        for surface in SURFACES:
            gain = row.gains[surface]
            ends = (gain.mean - gain.half_width, gain.mean + gain.half_width)
            cells += [cell(row.without[surface].mean), cell(gain.mean), *map(cell, ends)]
        lines.append(cells)
    return csv_text([header, *lines])


def gains_markdown(rows: Sequence[GainRow]) -> str:
    header = ["scene", "moment", "pairs"]
    for surface in SURFACES:
        header += [f"F {surface}, none", f"gain by feedback, {surface}"]
    lines = []
    for row in rows:
        cells = [row.scene, f"{row.moment}, {row.time_s:.0f} s", str(row.gains["visible"].count)]
        for surface in SURFACES:
            cells += [spread_text(row.without[surface], 3), gain_text(row.gains[surface])]
        lines.append(cells)
    return markdown([header, *lines])


def spread_text(spread: Spread, decimals: int) -> str:
    if not spread.known:
        return UNKNOWN
    text = f"{spread.mean:.{decimals}f}"
    if math.isfinite(spread.deviation):
        text += f" ± {spread.deviation:.{decimals}f}"
    return text if spread.known == spread.count else f"{text} ({spread.known} of {spread.count})"


def gain_text(gain: Difference) -> str:
    """With the ends of its interval; in bold where that leaves out zero."""
    if not math.isfinite(gain.mean):
        return UNKNOWN
    if not math.isfinite(gain.half_width):
        return f"{gain.mean:+.4f}"
    text = f"{gain.mean:+.4f} [{gain.mean - gain.half_width:+.4f}, {gain.mean + gain.half_width:+.4f}]"
    return f"**{text}**" if abs(gain.mean) > gain.half_width else text


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """A table; the first row is its head, and all columns but the first are set to the right."""

    def lines() -> Iterator[str]:
        head, *body = rows
        yield f"| {' | '.join(head)} |"
        yield "|---" + "|---:" * (len(head) - 1) + "|"
        for row in body:
            yield f"| {' | '.join(row)} |"

    return "\n".join(lines())


def cell(value: float) -> object:
    return round(value, 6) if math.isfinite(value) else ""


def csv_text(rows: Sequence[Sequence[object]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()
