"""Do obstacle rows keep drones from what stands in a room, and what does that cost: docs/obstacles.md.

    PYTHONPATH=.:tests .venv/bin/python -m faults.obstacle_study --rooms N [--first N] [--folder FOLDER] [--seconds S]

Flies ``room-1`` to ``room-N`` with four drones, with the rows and without, each as ``covrecon run`` flies it: in
lockstep, with real processes and a map of images. A flight ends when J is below `REACHED` or after S seconds. What lies
in FOLDER already is not flown again, so a study goes on where it was broken off; the table holds what there is.

Drones start where the formation places them, or higher where that is nearer to furniture than they keep: a crew looks.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from faults.measured_page import write_measured
from faults.run_flight import run_flight
from protocol.formation import Start, formation
from protocol.mission import Flight as Region
from protocol.triangles import squared_distance
from sim_bridge.scenes.cache import scene_cache
from sim_bridge.scenes.scene import load_scene

PAGE = Path("docs/obstacles.md")
REACHED = 0.25
SECONDS = 300.0
DRONES = 4
SEPARATION_M = 1.0
WALLS_M = 3.4
"""Of the rooms, at 3.5 m from the middle, as their crew would measure them."""
MISSION = """\
name = "obstacles"
duration_s = {seconds}
stop_below = {reached}
[flight]
separation_m = {separation}
boundary = [[-{walls}, -{walls}], [{walls}, -{walls}], [{walls}, {walls}], [-{walls}, {walls}]]
[flight.obstacles]
enabled = {enabled}
[simulation]
scene = "room-{room}"
[recording]
enabled = false
report = false
{drones}
"""
START = """
[[drones]]
id = {id}
start = {start}
"""
ABOVE_ALL_M = 2.5
"""Height of a start in a room where the formation's own is too near to something."""


@dataclass(frozen=True, slots=True)
class Flight:
    """What came of one."""

    contacts: int
    min_separation_m: float
    importance: float
    reached_s: float | None
    """When J fell below `REACHED`; None if it did not."""
    fallbacks: int
    f_score_visible: float | None


def fly(room: int, *, enabled: bool, seconds: float, folder: Path) -> Flight:
    """Flown now, or before."""
    place = folder / f"room-{room}-{'with' if enabled else 'without'}"
    figures = place / "figures.json"
    if not figures.exists():
        place.mkdir(parents=True, exist_ok=True)
        mission = place / "mission.toml"
        mission.write_text(
            MISSION.format(
                seconds=seconds,
                reached=REACHED,
                separation=SEPARATION_M,
                walls=WALLS_M,
                enabled=str(enabled).lower(),
                room=room,
                drones="".join(START.format(id=k, start=list(start)) for k, start in enumerate(starts(room), start=1)),
            )
        )
        figures.write_text(json.dumps(_figures(run_flight(mission))))
    return Flight(**json.loads(figures.read_text()))


def starts(room: int) -> Iterator[Start]:
    """Of the four drones."""
    triangles = load_scene(f"room-{room}", relative_to=Path(), cache=scene_cache()).triangles
    region = Region(separation_m=SEPARATION_M)
    for start in formation(region, DRONES):
        nearest = min(squared_distance(np.array(start[:3], np.float32), corners) for corners in triangles)
        yield start if nearest >= region.clearance_m**2 else (*start[:2], ABOVE_ALL_M, *start[3:])


def _figures(run: Path) -> dict[str, Any]:
    """Of a run's folder, as `Flight` has them."""
    summary = json.loads((run / "summary.json").read_text())
    reached = summary["exit_reason"] == f"importance fell below {REACHED:g}"
    return {
        "contacts": sum(summary["contacts"].values()),
        "min_separation_m": summary["min_separation_m"],
        "importance": summary["J"],
        "reached_s": summary["sim_time_s"] if reached else None,
        "fallbacks": sum(summary["fallbacks"].values()),
        "f_score_visible": summary["f_score_visible"],
    }


def table(flown: Mapping[bool, Sequence[Flight]], seconds: float) -> Iterator[str]:
    """Markdown; by whether the rows were on."""
    yield (
        f"| {DRONES} drones | rooms | contacts | in rooms | separations below {SEPARATION_M:g} m"
        f" | J < {REACHED:g} within {seconds:g} s | after, s: median (worst) | J at the end: worst | F visible: mean |"
    )
    yield "|---|---|---|---|---|---|---|---|---|"
    for enabled, name in ((True, "with obstacle rows"), (False, "without")):
        flights = flown[enabled]
        if not flights:
            continue
        times = sorted(flight.reached_s for flight in flights if flight.reached_s is not None)
        took = f"{times[len(times) // 2]:.0f} ({times[-1]:.0f})" if times else "–"
        scores = [flight.f_score_visible for flight in flights if flight.f_score_visible is not None]
        mean = f"{sum(scores) / len(scores):.3f}" if scores else "–"
        yield (
            f"| {name} | {len(flights)} | {sum(flight.contacts for flight in flights)}"
            f" | {sum(flight.contacts > 0 for flight in flights)}"
            f" | {sum(flight.min_separation_m < SEPARATION_M for flight in flights)}"
            f" | {len(times)} | {took} | {max(flight.importance for flight in flights):.3f} | {mean} |"
        )


def main(arguments: Sequence[str]) -> None:
    parser = argparse.ArgumentParser(prog="faults.obstacle_study")
    parser.add_argument("--rooms", type=int, required=True, help="how many, from the first on")
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--folder", type=Path, default=Path("obstacle-study"))
    parser.add_argument("--seconds", type=float, default=SECONDS)
    asked = parser.parse_args(arguments)
    flown: dict[bool, list[Flight]] = {True: [], False: []}
    rooms = range(asked.first, asked.first + asked.rooms)
    for number, room in enumerate(rooms, start=1):
        for enabled, flights in flown.items():
            flight = fly(room, enabled=enabled, seconds=asked.seconds, folder=asked.folder)
            flights.append(flight)
            print(f"{number}/{len(rooms)} room-{room} {'with' if enabled else 'without'}: {flight}", flush=True)
        write_measured(PAGE, "\n".join(table(flown, asked.seconds)))
    print("\n".join(table(flown, asked.seconds)))


if __name__ == "__main__":
    main(sys.argv[1:])
