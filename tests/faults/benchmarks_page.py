"""``python -m faults.benchmarks_page`` writes docs/benchmarks.md and its picture from what ``make bench`` measured."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from matplotlib import rc_context
from matplotlib.figure import Figure

from protocol.guard import ROOT

RESULTS = ROOT / "benchmarks.json"
DOCS = ROOT / "docs"
PAGE, PICTURE = "benchmarks.md", "images/field-growth.svg"
GROWTH = ("field_tick_growth_m", "field_tick_growth_n")

Row = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Entry:
    """What a benchmark means, by its name; ``*`` stands for anything."""

    pattern: str
    meaning: str
    bar: float | None = None
    """How many times better than what it is measured against it has to be; None: nothing was asked for."""


SECTIONS: Mapping[str, Sequence[Entry]] = {
    "The kernel": (
        Entry("field_tick_117600", "a tick of the default field: decay by four drones, one drone's terms", 100),
        Entry("field_tick_15e6", "the same over the paper's field of 1.5·10⁷ cells, median", 300),
        Entry("field_tick_15e6_p99", "... and in the slowest hundredth of ticks", 1),
        Entry(
            "field_tick_growth_m", "how its cost grows with the field, where the drones see the same cells of it", 100
        ),
        Entry("field_tick_growth_n", "how it grows with the drones", 0.9),
    ),
    "A whole tick over 1.5·10⁷ cells": (
        Entry("agent_tick_15e6_*", "all that one agent does for a tick: messages, decay, digest, jumps, program", 1),
        Entry("ground_tick_15e6_*", "likewise the ground station's event loop", 1),
        Entry("late_join_15e6", "how long one that joins late fetches φ, page by page"),
        Entry("late_join_15e6_tick", "the most that it takes in a tick meanwhile", 1),
        Entry("memory_phi_*", "what a process takes more than over the default field: all its copies of φ", 1),
        Entry("lockstep_flight_15e6", "two drones as fast as it goes, without images"),
    ),
    "The quadratic program": (Entry("qp_solve", "one drone's program among four", 20),),
    "Map and feedback": (
        Entry("image_to_fused_*", "decoding a keyframe, its depth map, its confirmation, its fusion", 1),
        Entry("keyframes_sustained_*", "keyframes that come into the map, on all cores", 1),
        Entry("keyframe_cpu_*", "what one takes of the processor, poses not mended", 1),
        Entry("plane_sweep_*", "the matching costs of one keyframe"),
        Entry("mesh_blocks_*", "the mesh of the whole box, and the blocks of it that changed, for those who watch", 1),
        Entry("mesh_*", "the mesh of the whole box, by the size of its voxels", 1),
        Entry("memory_map_growth_*", "what the process grows by over 5000 keyframes, after the first 1000", 1),
        Entry("memory_map_*", "map, kept keyframes and mesh after 5000 keyframes", 1),
        Entry("feedback_grid", "an update of the grid method", 20),
        Entry("feedback_grid_update", "the same", 1),
        Entry("feedback_m3c2", "an update of M3C2, where a part of the map has changed", 5),
        Entry("feedback_m3c2_*", "the same, measured otherwise"),
        Entry("pose_refinement", "mending a keyframe's pose, against its depth and fusion"),
        Entry("keyframes_full_4", "keyframes that come into the map while four drones fly in lockstep", 1),
    ),
    "Missions in lockstep": (
        Entry("lockstep_flight_4", "four drones without images", 1),
        Entry("lockstep_full_4", "four drones, the map, the feedback", 1),
        Entry("memory_agent", "resident memory of an agent at most", 1),
        Entry("memory_ground_station", "likewise of the ground station", 1),
    ),
    "States and setpoints in real time": (
        Entry("sixteen_state_age_*", "how old a state of sixteen drones is where it arrives", 1),
        Entry("sixteen_cpu*", "what sixteen drones take of the processor", 1),
        Entry("sixteen_*", "of sixteen drones in two minutes", 1),
        Entry("setpoint_p*", "from the solved program to the setpoint at a PX4-like vehicle", 1),
        Entry("setpoint_late_ticks_*", "setpoints half a tick late"),
        Entry(
            "team_*", "large teams: traffic of each drone, and what its states gathered by the ground station change"
        ),
    ),
    "Recording": (
        Entry("recorder_core_share", "what the recorder takes of a core while four drones fly in real time", 1),
        Entry("recorder_file", "how fast its file grows", 1),
        Entry("recorder_*", "how long it holds up a call, and how late ticks begin"),
    ),
    "A drone's computer": (Entry("drone_*", "installing and starting what a drone needs", 1),),
    "Others": (Entry("*", ""),),
}

HEAD = """# Benchmarks

`make bench` measures, prints this table, and leaves it in `benchmarks.json`. `python -m faults.benchmarks_page` (with
`PYTHONPATH=.:tests`) makes this page of that file.

{where}

Machines are shared and noisy: each figure is compared with something in the same run, its peer, its plain form, or the
time or memory that there is. "times" says how many times better it is, "bar" how many times better it should be; what
is below its bar stands out. ms CPU are of one core.
"""
TABLE = """
## {title}

| entry | what it is | figure | against | times | bar |
|---|---|---|---|---|---|
"""
CAPTION = """
![What a tick costs with the size of the field and of the team](images/field-growth.svg)

Left, four drones over the default lattice in an ever larger box: only the window around each drone is visited, so that
the cost does not grow with the field. Right, one to sixteen drones over 1.5·10⁷ cells; the dotted line is in proportion
to the first.
"""


def entry_of(name: str) -> tuple[str, Entry]:
    """Section and meaning of a benchmark."""
    return next(
        (title, entry) for title, entries in SECTIONS.items() for entry in entries if fnmatchcase(name, entry.pattern)
    )


def table_row(row: Row, entry: Entry) -> str:
    held = entry.bar is None or row["ratio"] >= entry.bar
    bar = "" if entry.bar is None else f"{entry.bar:g}"
    figure = f"{row['value']:.4g} {row['unit']}"
    ratio = f"{row['ratio']:.3g}"
    cells = (f"`{row['name']}`", entry.meaning, figure, row["against"], ratio if held else f"**{ratio}**", bar)
    return f"| {' | '.join(cells)} |\n"


def page(rows: Sequence[Row]) -> str:
    """docs/benchmarks.md."""
    places = Counter((row["day"], row["machine"]) for row in rows)
    where = "\n".join(f"- {count} entries on {day}: {machine}" for (day, machine), count in sorted(places.items()))
    text = HEAD.format(where=where)
    for title, entries in SECTIONS.items():
        lines = [table_row(row, entry) for entry in entries for row in rows if entry_of(row["name"]) == (title, entry)]
        if lines:
            text += TABLE.format(title=title) + "".join(lines)
            text += CAPTION if title == "The kernel" and curves(rows) else ""
    return text


def curves(rows: Sequence[Row]) -> list[list[tuple[float, float]]]:
    """Points of the two curves of `GROWTH`; empty if one was not measured."""
    known = {row["name"]: [(x, y) for x, y in row["curve"]] for row in rows if "curve" in row}
    return [known[name] for name in GROWTH] if known.keys() >= set(GROWTH) else []


def picture(points: Sequence[Sequence[tuple[float, float]]]) -> Figure:
    """Cost of a tick over cells, and over drones."""
    figure = Figure(figsize=(8.0, 3.0), layout="constrained")
    cells, drones = figure.subplots(1, 2)
    for axes, curve, label in ((cells, points[0], "cells of the field"), (drones, points[1], "drones")):
        axes.plot(*zip(*curve, strict=True), marker="o", color="#1f5fa8")
        axes.set(xlabel=label, ylabel="a tick, ms CPU", ylim=(0, 1.3 * max(y for _, y in curve)))
        axes.grid(alpha=0.3)
    cells.set_xscale("log")
    first = points[1][0]
    most = points[1][-1][0]
    drones.plot((0, most), (0, first[1] / first[0] * most), color="#888888", linestyle=":")
    drones.set(xlim=(0, None), xticks=range(0, int(most) + 1, 4))
    return figure


def write(rows: Sequence[Row], docs: Path) -> None:
    (docs / PAGE).write_text(page(rows), encoding="utf-8")
    if points := curves(rows):
        with rc_context({"svg.hashsalt": "covrecon", "svg.fonttype": "none"}):  # the same figures, the same bytes
            picture(points).savefig(docs / PICTURE, metadata={"Date": None})


def main() -> int:
    if not RESULTS.exists():
        print(f"{RESULTS}: nothing was measured yet; run make bench", file=sys.stderr)
        return 1
    write(json.loads(RESULTS.read_text()), DOCS)
    print(DOCS / PAGE)
    return 0


if __name__ == "__main__":
    sys.exit(main())
