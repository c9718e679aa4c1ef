"""An evaluation as tables for people."""

from __future__ import annotations

from collections.abc import Iterator

from rich.console import RenderableType
from rich.table import Table

from ground_station.evaluate.figures import Evaluation
from ground_station.evaluate.reference import Reference
from ground_station.evaluation import Score

SURFACES = ("visible", "exposed", "objects")


def tables(evaluation: Evaluation, reference: Reference) -> Iterator[RenderableType]:
    yield _scores(evaluation)
    yield _distance_line(evaluation)
    if evaluation.things:
        yield _things(evaluation)
    if not reference.culled:
        yield "TRUTH is a mesh alone: all of its surface counts, also what no camera can see"


def _scores(evaluation: Evaluation) -> Table:
    table = Table(title=f"{evaluation.triangles} triangles, at {100 * evaluation.threshold_m:g} cm")
    for heading in ("", "F", "F of a bare floor", "precision", "recall"):
        table.add_column(heading, justify="left" if not heading else "right")
    for name in SURFACES:
        ours: Score = getattr(evaluation.scores, name)
        floor: Score = getattr(evaluation.floor, name)
        table.add_row(name, *(f"{value:.3f}" for value in (ours.f, floor.f, ours.precision, ours.recall)))
    return table


def _distance_line(evaluation: Evaluation) -> str:
    distances = evaluation.distances
    if distances.to_truth_m is None or distances.to_map_m is None or distances.chamfer_m is None:
        return "Chamfer distance: none, one of the surfaces is empty"
    return (
        f"Chamfer distance {100 * distances.chamfer_m:.2f} cm: {100 * distances.to_truth_m:.2f} cm from the map to the "
        f"true surface, {100 * distances.to_map_m:.2f} cm from the visible surface to the map"
    )


def _things(evaluation: Evaluation) -> Table:
    table = Table(title="furniture, the largest first")
    for heading in ("", "share of surface", "F", "precision", "recall"):
        table.add_column(heading, justify="left" if not heading else "right")
    for thing in evaluation.things:
        shares = (thing.score.f, thing.score.precision, thing.score.recall)
        table.add_row(thing.name, f"{100 * thing.share:.1f} %", *(f"{value:.3f}" for value in shares))
    return table
