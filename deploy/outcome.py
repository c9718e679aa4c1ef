"""What a run came to, in a few lines for a terminal, from the ``summary.json`` that the ground station leaves."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from protocol.errors import ProcessError

SUMMARY_FILE = "summary.json"
REPORT_FILE = "report.html"


class Scores(BaseModel):
    """F-scores at 5 cm; None where no truth is known."""

    model_config = ConfigDict(frozen=True)

    f_score_visible: float | None
    f_score_exposed: float | None
    f_score_objects: float | None


class Outcome(Scores):
    """The keys of ``summary.json`` that are told here; `ground_station.results` says what they mean."""

    exit_reason: str
    importance: Annotated[float, Field(alias="J")]
    sim_time_s: float
    floor_baseline: Scores
    min_separation_m: float | None
    jumps: int
    keyframes: int
    fallbacks: dict[str, int]
    contacts: dict[str, int] | None = None


def read_outcome(run: Path) -> Outcome:
    """Raises `ProcessError` when the run left no readable summary."""
    path = run / SUMMARY_FILE
    try:
        return Outcome.model_validate_json(path.read_bytes())
    except OSError as error:
        raise ProcessError(f"{path}: {error.strerror}") from error
    except ValidationError as error:
        raise ProcessError(f"{path}: {error}") from error


def describe(outcome: Outcome, run: Path) -> Iterator[str]:
    """Lines for a person; the F-scores stand beside what a bare floor would get, which a map has to beat."""
    yield f"J {outcome.importance:.3f} after {outcome.sim_time_s:.0f} s of flight: {outcome.exit_reason}"
    for surface in ("visible", "exposed", "objects"):
        score, floor = (getattr(scores, f"f_score_{surface}") for scores in (outcome, outcome.floor_baseline))
        if score is not None and floor is not None:
            yield f"F-score at 5 cm, {surface + ':':8} {score:.3f} (a bare floor: {floor:.3f})"
    if outcome.min_separation_m is not None:
        yield f"smallest separation {outcome.min_separation_m:.3f} m"
    if outcome.contacts is not None:
        yield f"{sum(outcome.contacts.values())} contacts with the scene"
    yield f"{outcome.keyframes} keyframes, {outcome.jumps} jumps, {sum(outcome.fallbacks.values())} ticks of braking"
    report = run / REPORT_FILE
    yield f"report: {report}" if report.is_file() else f"run folder: {run} (it holds no {REPORT_FILE})"
