"""``python -m ground_station.evaluate``: the process behind ``covrecon evaluate``; the launcher does without Open3D."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from rich.console import Console

from ground_station.durable import replace_file
from ground_station.evaluate.errors import draw_errors, error_mesh, missing_mesh
from ground_station.evaluate.figures import evaluate
from ground_station.evaluate.reference import box_of, map_of, open_reference
from ground_station.evaluate.text import tables
from ground_station.evaluation import THRESHOLD_M
from ground_station.mesh_files import ply
from protocol.errors import CovreconError, SceneError, StorageError


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m ground_station.evaluate")
    parser.add_argument("mesh", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("--threshold", type=float, default=THRESHOLD_M, help="metres")
    parser.add_argument("--picture", type=Path, help="PNG of both surfaces in the colours of their distance")
    parser.add_argument("--ply", type=Path, help="the map in the colours of its distance to the truth")
    parser.add_argument("--json", action="store_true")
    parsed = parser.parse_args(arguments)
    try:
        _evaluate(parsed.mesh, parsed.truth, parsed.threshold, parsed.picture, parsed.ply, as_json=parsed.json)
    except CovreconError as error:
        sys.stderr.write(f"{error}\n")
        return 2 if isinstance(error, SceneError) else 1
    return 0


def _evaluate(
    mesh: Path, truth: Path, threshold_m: float, picture: Path | None, coloured: Path | None, *, as_json: bool
) -> None:
    vertices, faces = map_of(mesh)
    reference = open_reference(truth, box_of(mesh))
    evaluation = evaluate(vertices, faces, reference, threshold_m)
    if as_json:
        sys.stdout.write(json.dumps(evaluation.as_json(), indent=2) + "\n")
    else:
        console = Console(highlight=False, markup=False, soft_wrap=True)
        for told in tables(evaluation, reference):
            console.print(told)
    try:
        if picture is None and coloured is None:
            return
        wrong = error_mesh(vertices, faces, reference, threshold_m)
        if coloured is not None:
            replace_file(coloured, [ply(wrong.vertices, wrong.faces, wrong.colours)])
        if picture is not None:
            missing = missing_mesh(vertices, faces, reference, threshold_m)
            draw_errors(wrong, missing, reference, threshold_m, picture)
    except OSError as error:
        raise StorageError(f"{error.filename}: {error.strerror}") from error
    for written in (picture, coloured):
        if written is not None and not as_json:
            sys.stdout.write(f"{written}\n")


if __name__ == "__main__":
    sys.exit(main())
