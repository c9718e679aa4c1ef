"""A study's results as files: tables, figures, and a page of Markdown that shows them."""

from __future__ import annotations

import math
import re
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

from ground_station.durable import replace_file
from ground_station.study import paper
from ground_station.study.drawings import draw_curves, draw_gains, draw_portraits, shown
from ground_station.study.flown import Flown, load_flown
from ground_station.study.map_pages import write_maps
from ground_station.study.mapped import load_mapped
from ground_station.study.meshes import draw_meshes
from ground_station.study.plan_file import Plan, read_plan
from ground_station.study.tables import (
    MethodRow,
    gain_rows,
    gains_csv,
    gains_markdown,
    markdown,
    method_rows,
    methods_csv,
    methods_markdown,
    orders,
)
from protocol.errors import CovreconError, StorageError

PAGE_FILE = "evaluation.md"
IMAGES = "images"
"""Beside a page of the documentation, where its figures come."""


def write_study(folder: Path) -> Path:
    """Write tables, figures and page of the study in ``folder`` from the flights that are there; the page's path.

    Raises:
        CovreconError: there is no study or no flight yet, or one cannot be read, or the disk refuses a file.
    """
    plan = read_plan(folder)
    try:
        text = "\n".join(_maps_page(folder, plan) if plan.study == "reconstruction" else _page(folder, plan)) + "\n"
        replace_file(folder / PAGE_FILE, [text.encode()])
    except OSError as error:
        raise StorageError(f"{error.filename or folder}: {error.strerror}") from error
    return folder / PAGE_FILE


def put_into(page: Path, folder: Path) -> None:
    """Put the study's page between the comments of its name in ``page``, and its figures beside it.

    Raises:
        CovreconError: the page has no such comments, or cannot be read or written.
    """
    study = read_plan(folder).study
    text = (folder / PAGE_FILE).read_text(encoding="utf-8")
    start, end = f"<!-- {study} -->", f"<!-- /{study} -->"
    try:
        known = page.read_text(encoding="utf-8")
        if start not in known or end not in known:
            raise CovreconError(f"{page}: lacks the lines {start} and {end}, between which the results come")
        images = page.parent / IMAGES
        images.mkdir(exist_ok=True)
        for name in re.findall(r"\]\(([^)]*\.(?:svg|png))\)", text):
            shutil.copyfile(folder / name, images / f"{study}-{name}")
            text = text.replace(f"]({name})", f"]({IMAGES}/{study}-{name})")
        filled = re.sub(f"{start}.*?{end}", lambda _: f"{start}\n{text}{end}", known, flags=re.DOTALL)
        replace_file(page, [filled.encode()])
    except OSError as error:
        raise StorageError(f"{error.filename or page}: {error.strerror}") from error


def _page(folder: Path, plan: Plan) -> Iterator[str]:
    flights = load_flown(folder, plan)
    if not flights:
        raise CovreconError(f"{folder}: no flight is flown to its end yet")
    yield from (_paper_page if plan.study == "paper" else _feedback_page)(folder, plan, flights)


def _maps_page(folder: Path, plan: Plan) -> Iterator[str]:
    maps = load_mapped(folder, plan)
    if not maps:
        raise CovreconError(f"{folder}: no map is made yet")
    made = f"{len(maps)} of {len(plan.maps)} maps of {len(plan.flights)} flights"
    yield from _heading("How good maps of random rooms are", plan, made)
    yield from write_maps(folder, maps)


def _paper_page(folder: Path, plan: Plan, flights: list[Flown]) -> Iterator[str]:
    rows = method_rows(flights)
    replace_file(folder / "methods.csv", [methods_csv(rows).encode()])
    yield from _heading("Every method of the paper", plan, _flown(plan, flights))
    yield methods_markdown(rows)
    yield ""
    yield "Mean ± standard deviation over the seeds; (n of m) where only so many flights reached it. F, precision and"
    yield "recall are of the visible surface unless named otherwise, at 5 cm; the path is of all drones together."
    yield ""
    yield from _order(rows)
    yield from _teams(rows)
    for column, label, name in (("importance", "importance J", "J"), ("f_score_visible", "F visible", "F")):
        yield from shown(
            f"{name}(t), mean and range over the seeds", draw_curves(flights, column, label, folder / name)
        )
    yield from shown("Phase portraits by J_th", draw_portraits(flights, folder / "portraits"))
    yield from shown("Final maps of the first seed", draw_meshes(flights, folder / "meshes"))


def _feedback_page(folder: Path, plan: Plan, flights: list[Flown]) -> Iterator[str]:
    rows = gain_rows(flights, plan.duration_s)
    replace_file(folder / "gains.csv", [gains_csv(rows).encode()])
    yield from _heading("Does feedback help?", plan, _flown(plan, flights))
    yield gains_markdown(rows)
    yield ""
    yield "F at 5 cm with grid feedback minus F without, at the same mission time, of flights with the same seed; in"
    yield "brackets the 95 % confidence interval of the mean difference (Student's t), bold where it leaves out zero."
    yield ""
    yield from shown("Gain over time", draw_gains(flights, plan.duration_s, folder / "gain"))


def _heading(title: str, plan: Plan, done: str) -> Iterator[str]:
    yield f"### {title}"
    yield ""
    yield f"`{plan.command}`: {done}, on {plan.machine}."
    yield ""


def _flown(plan: Plan, flights: Sequence[Flown]) -> str:
    return f"{len(flights)} of {len(plan.flights)} flights of {plan.duration_s:g} s"


def _order(rows: Sequence[MethodRow]) -> Iterator[str]:
    """The methods of one drone from best to worst."""
    ranked = orders(rows)
    if len(ranked[0][1]) < 2:
        return
    yield "Order of the methods, one drone, the best first:"
    yield ""
    yield markdown([["by", *map(str, range(1, len(ranked[0][1]) + 1))], *([name, *order] for name, order in ranked)])
    yield ""


def _teams(rows: Sequence[MethodRow]) -> Iterator[str]:
    teams = {row.series[2]: row for row in rows if row.series[1] == "grid" and row.series[3] == paper.THRESHOLD}
    if not {1, 4} <= set(teams):
        return
    one, four = teams[1].spreads, teams[4].spreads
    speedup = one["time_to_0.25_s"].mean / four["time_to_0.25_s"].mean
    if math.isfinite(speedup):  # both reached it
        printed = paper.QUARTER_S["grid", 1] / paper.QUARTER_S["grid", 4]
        yield f"Four drones reach J = 0.25 in 1/{speedup:.2f} of one drone's time (paper: 1/{printed:.2f})."
    difference = four["f_visible"].mean - one["f_visible"].mean
    yield f"Four drones' F of the visible surface is one drone's {difference:+.3f}."
    yield ""
