"""``make faults``: every fault on real processes, repeated deaths of the ground station, and random schedules.

Writes ``docs/reliability.json``, a list of {fault, drones, held, figures}, and the same as ``docs/reliability.md``.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from pathlib import Path

from faults.ground_kills import KILLS, fly_with_kills
from faults.judgement import Figures
from faults.matrix import TEAMS, WORKERS, Result, cells, fly_all
from faults.random_schedules import outcome_of
from faults.schedule import FLIGHT_S, schedule
from faults.trial import Outcome
from protocol.guard import ROOT

DOCS = ROOT / "docs"
SCHEDULES_ROW = "random schedules"
SEEDS = 200

HEAD = """# What the system survives

Written by `make faults` on {day}, on {cores} cores ({machine}): {held} of {all} rows held. It takes most of an hour;
the last run, of {part}, took {minutes:.0f} minutes. `reliability.json` has the same rows with all figures.
`python -m faults.matrix --only TEXT` flies single cells, `python -m faults.reliability --part schedules` one part anew.

Each cell of the first table is one mission of real processes in real time (router, simulator, ground station, agents)
that maps a table on a floor by its own images. The fault strikes in the middle of it and is then over. A cell holds if

* the true distance of any two drones is at least `separation_m` at every tick, also while nobody hears anybody;
* afterwards all replicas of phi, asked for the same tick, equal the ground station's (within four times
  `replication.tolerance`, root mean square of a block; "bit-equal" says that it was to the last bit);
* every jump that was published is in the journal as it was published, in the same epoch, and no replica has others;
* J falls to the mission's target, by which the ground station ends the mission, and all processes end by themselves.

"healed" is the time from the end of the fault until everybody is back, knows all of phi and all jumps, and lags by
less than 1.5 s; a process that is started again takes some seconds of it to import. "published" counts jumps.

| fault | drones | held | healed [s] | replicas | separation [m] | published | J | remarks |
|---|---|---|---|---|---|---|---|---|
"""

SCHEDULES = """
## Random schedules

{seeds} missions of {seconds:g} s in virtual time with several faults each, on a simulated network, from one seed each:
the real agents, ground station and simulator, without images. `python -m faults.random_schedules --first SEED --seeds 1
--verbose` repeats one byte for byte.

| drones | schedules | with violations | smallest separation [m] | jumps | all replicas bit-equal |
|---|---|---|---|---|---|
"""

SHOWN = {"violations", "healed_in_s", "bit_equal", "worst_rms", "min_separation_m", "acknowledged", "J"}
"""Figures that have a column; those in `PLAIN` need none."""
PLAIN = {"jumps", "ticks", "epochs", "others_ended_in_s", "struck_at_s", "surface_m2"}


def row(result: Result) -> str:
    figures = result.figures
    replicas = (
        "bit-equal" if figures.get("bit_equal") else f"{figures['worst_rms']:.1e}" if "worst_rms" in figures else ""
    )
    remarks = [f"{name.replace('_', ' ')}: {value}" for name, value in figures.items() if name not in SHOWN | PLAIN]
    remarks += [str(violation).partition("\n")[0] for violation in figures.get("violations", [])]
    numbers = [figures.get(name, "") for name in ("healed_in_s", "min_separation_m", "acknowledged", "J")]
    healed, separation, published, importance = numbers
    columns = [
        result.fault,
        result.drones,
        "yes" if result.held else "**no**",
        healed,
        replicas,
        separation,
        published,
        importance,
        "; ".join(remarks),
    ]
    return f"| {' | '.join(map(str, columns))} |"


def fly_schedules(seeds: int, say: Callable[[str], None]) -> list[Result]:
    """One result a team size."""
    by_team: dict[int, list[Outcome]] = defaultdict(list)
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        for outcome in pool.map(outcome_of, range(seeds)):
            say("\n          VIOLATION: ".join([str(outcome), *outcome.violations]))
            by_team[len(schedule(outcome.seed).mission.drones)].append(outcome)
    return [_result_of(drones, outcomes) for drones, outcomes in sorted(by_team.items())]


def _result_of(drones: int, outcomes: Sequence[Outcome]) -> Result:
    violated = {outcome.seed: outcome.violations for outcome in outcomes if outcome.violations}
    figures: Figures = {
        "schedules": len(outcomes),
        "seconds_each": FLIGHT_S,
        "with_violations": len(violated),
        "jumps": sum(outcome.jumps for outcome in outcomes),
        "bit_equal": sum(o.comparison is not None and o.comparison.bit_equal for o in outcomes),
    }
    if drones > 1:
        figures["min_separation_m"] = round(min(outcome.separation_m for outcome in outcomes), 3)
    if violated:
        figures["violations"] = {str(seed): violations for seed, violations in violated.items()}
    return Result(SCHEDULES_ROW, drones, not violated, figures)


def read_rows(docs: Path) -> tuple[list[Result], list[Result]]:
    """Cells and schedules of the run before."""
    rows = [Result(**row) for row in json.loads((docs / "reliability.json").read_text())]
    schedules = [row for row in rows if row.fault == SCHEDULES_ROW]
    return [row for row in rows if row not in schedules], schedules


def write_reliability(
    flown: Sequence[Result], schedules: Sequence[Result], part: str, wall_s: float, docs: Path
) -> None:
    results = [*flown, *schedules]
    (docs / "reliability.json").write_text(json.dumps([asdict(result) for result in results], indent=1) + "\n")
    text = HEAD.format(
        day=time.strftime("%Y-%m-%d"),
        minutes=wall_s / 60,
        part={"all": "all parts"}.get(part, f"the {part} alone"),
        cores=os.cpu_count(),
        machine=f"{platform.machine()}, Python {platform.python_version()}",
        held=sum(result.held for result in results),
        all=len(results),
    )
    text += "\n".join(map(row, flown)) + "\n"
    if schedules:
        total = sum(result.figures["schedules"] for result in schedules)
        text += SCHEDULES.format(seeds=total, seconds=schedules[0].figures["seconds_each"])
        names = ("schedules", "with_violations", "min_separation_m", "jumps", "bit_equal")
        for result in schedules:
            text += f"| {result.drones} | {' | '.join(str(result.figures.get(name, '')) for name in names)} |\n"
    (docs / "reliability.md").write_text(text)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m faults.reliability", description=__doc__)
    parser.add_argument("--seeds", type=int, default=SEEDS, help="random schedules")
    parser.add_argument("--kills", type=int, default=KILLS, help="deaths of the ground station in one flight")
    parser.add_argument("--docs", type=Path, default=DOCS, help="where the two files go")
    parser.add_argument(
        "--part", choices=("all", "cells", "schedules"), default="all", help="the others' rows stay as they are"
    )
    arguments = parser.parse_args()
    began = time.monotonic()

    def say(text: str) -> None:
        print(f"{time.monotonic() - began:6.0f} s  {text}", flush=True)

    flown, schedules = ([], []) if arguments.part == "all" else read_rows(arguments.docs)
    if arguments.part != "cells":
        schedules = fly_schedules(arguments.seeds, say)
    if arguments.part != "schedules":
        say(f"{len(cells())} cells: faults x {TEAMS} drones")
        flown = [*fly_all(cells(), say, WORKERS), fly_with_kills(arguments.kills, say)]
    write_reliability(flown, schedules, arguments.part, time.monotonic() - began, arguments.docs)
    bad = [result for result in (*flown, *schedules) if not result.held]
    say(f"{len(bad)} rows did not hold; {arguments.docs / 'reliability.md'}")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
