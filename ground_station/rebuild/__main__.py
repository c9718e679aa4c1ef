"""``python -m ground_station.rebuild``: the process behind ``covrecon reconstruct``, and of maps in a study."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, get_args

from rich.console import Console
from rich.progress import Progress as Bars
from rich.progress import TaskID

from ground_station.durable import replace_file
from ground_station.evaluate.figures import Evaluation, evaluate
from ground_station.evaluate.reference import Reference, open_reference
from ground_station.evaluate.text import tables
from ground_station.evaluation import TRUTH_FILE
from ground_station.export.source import Progress, Source, open_source
from ground_station.mesh_files import glb, ply
from ground_station.rebuild.quality import Quality
from ground_station.rebuild.run import Rebuilt, default_output, rebuild, rebuilding_mission
from ground_station.rehearsal import rehearse
from ground_station.study.plan_file import TRUTH_MESH_FILE
from protocol.errors import CovreconError, MissionError, StorageError

WRITERS = {".ply": ply, ".glb": glb}
LINE_PERIOD_S = 5.0
"""Between two lines of progress where there is no terminal."""


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m ground_station.rebuild")
    parser.add_argument("run", type=Path, help="a run's folder, or a recording")
    parser.add_argument("--quality", choices=get_args(Quality), default="high")
    parser.add_argument("--backend")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="change a setting")
    parser.add_argument("--out", type=Path, help="the mesh: PLY or GLB")
    parser.add_argument("--figures", type=Path, help="all figures as JSON")
    parsed = parser.parse_args(arguments)
    told = Console(stderr=True, highlight=False, markup=False, soft_wrap=True)
    try:
        _rebuild(parsed.run, parsed.quality, parsed.backend, parsed.set, parsed.out, parsed.figures, told)
    except CovreconError as error:
        told.print(str(error))
        return 2 if isinstance(error, MissionError) else 1
    return 0


def _rebuild(
    run: Path,
    quality: Quality,
    backend: str | None,
    settings: list[str],
    out: Path | None,
    figures: Path | None,
    told: Console,
) -> None:
    out = out or default_output(run)
    if out.suffix not in WRITERS:
        raise CovreconError(f"{out}: a mesh is written as {' or '.join(WRITERS)}")
    with _shown(told) as progress:
        source = open_source(run, progress)
        mission = rebuilding_mission(source.mission, quality, backend, settings)
        rehearse(mission)
        rebuilt = rebuild(source, mission)
    mesh = rebuilt.mesh
    if not len(mesh.faces):
        raise CovreconError(f"{run}: no surface was found: {_refusals(rebuilt)}")
    try:
        replace_file(out, [WRITERS[out.suffix](mesh.vertices, mesh.faces, mesh.colors)])
    except OSError as error:
        raise StorageError(f"{out}: {error.strerror}") from error
    asked = Console(highlight=False, markup=False, soft_wrap=True)
    asked.print(
        f"{out}: {len(mesh.faces)} triangles from {rebuilt.keyframes} keyframes, {rebuilt.unused} unused; "
        f"{1e3 * rebuilt.cpu_s / rebuilt.keyframes:.1f} ms of processor time each, {rebuilt.wall_s:.0f} s in all"
    )
    reference = _reference(source)
    evaluation = evaluate(mesh.vertices, mesh.faces, reference) if reference is not None else None
    if reference is not None and evaluation is not None:
        for line in tables(evaluation, reference):
            asked.print(line)
    if figures is not None:
        replace_file(figures, [(json.dumps(_told(rebuilt, evaluation), indent=2) + "\n").encode()])


def _reference(source: Source) -> Reference | None:
    """The truth in the same folder, as the simulator leaves it; a flight over real ground has none."""
    folder = source.path if source.path.is_dir() else source.path.parent
    has_truth = all((folder / name).exists() for name in (TRUTH_FILE, TRUTH_MESH_FILE))
    return open_reference(folder, source.mission.target) if has_truth else None


def _told(rebuilt: Rebuilt, evaluation: Evaluation | None) -> dict[str, Any]:
    return {
        "keyframes": rebuilt.keyframes,
        "unused": rebuilt.unused,
        "refused": dict(rebuilt.statistics.refused),
        "cpu_ms_per_keyframe": 1e3 * rebuilt.cpu_s / rebuilt.keyframes,
        "memory_bytes": rebuilt.statistics.memory_bytes,
        **(evaluation.as_json() if evaluation is not None else {}),
    }


def _refusals(rebuilt: Rebuilt) -> str:
    counts = {reason: count for reason, count in rebuilt.statistics.refused.items() if count}
    if not counts:
        return f"{rebuilt.unused} of {rebuilt.keyframes} keyframes were of no use"
    return ", ".join(f"{count} of {rebuilt.keyframes} keyframes {reason}" for reason, count in counts.items())


@contextmanager
def _shown(console: Console) -> Iterator[Progress]:
    """Bars on a terminal, a line now and then elsewhere."""
    if console.is_terminal:
        with Bars(console=console, transient=True) as bars:
            tasks: dict[str, TaskID] = {}

            def show(what: str, done: int, total: int) -> None:
                if what not in tasks:
                    tasks[what] = bars.add_task(what, total=total)
                bars.update(tasks[what], completed=done, total=total)

            yield show
        return
    said_s = time.monotonic()

    def say(what: str, done: int, total: int) -> None:
        nonlocal said_s
        if time.monotonic() - said_s >= LINE_PERIOD_S:
            said_s = time.monotonic()
            console.print(f"{what}: {100 * done / total:.0f} %")

    yield say


if __name__ == "__main__":
    sys.exit(main())
