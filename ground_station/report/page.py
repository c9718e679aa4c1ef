"""From a run's folder to one self-contained HTML file that asks the network for nothing."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from ground_station.report import content, figures
from ground_station.report.picture import oblique_view, png, view_from_above
from ground_station.report.run_data import Run, load_run

REPORT_FILE = "report.html"
PICTURE_FILE = "mesh.png"
OBLIQUE_PX = (1100, 570)
"""Width and height; sharp at the widest that the page gets."""
PLAN_PX = 560


@dataclass(frozen=True, slots=True)
class Panel:
    """A drawing, or the reason why there is none."""

    title: str
    svg: str | None
    missing: str
    tall: bool = False


def write_report(folder: Path) -> Path:
    """Write ``report.html`` and, if there is a map, ``mesh.png`` into a run's folder; gives the page's path.

    The same folder gives the same bytes. Raises MissionError without a readable mission, and CovreconError for any
    other file that is there but cannot be read.
    """
    run = load_run(folder)
    oblique = plan = None
    if run.mesh is not None:
        oblique = png(oblique_view(run.mesh, *OBLIQUE_PX))
        plan = png(view_from_above(run.mesh, run.mission.target.lower_m, run.mission.target.upper_m, PLAN_PX))
        (folder / PICTURE_FILE).write_bytes(oblique)
    summary = run.summary or {}
    template = Environment(
        loader=PackageLoader("ground_station.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    ).get_template("template.html")
    page = template.render(
        mission=run.mission,
        exit_reason=summary.get("exit_reason"),
        kpis=content.kpis(run),
        oblique=oblique and _embedded(oblique),
        plan=plan and _embedded(plan),
        no_map=_why_no_map(run),
        panels=list(_panels(run)),
        scores=content.score_rows(run),
        drones=content.drone_rows(run),
        hashes=[(name, summary[name]) for name in ("phi_sha256", "mesh_sha256") if summary.get(name)],
        versions=summary.get("versions", {}),
        settings=content.settings(run),
    )
    path = folder / REPORT_FILE
    path.write_text(page, encoding="utf-8")
    return path


def _embedded(image: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(image).decode()


def _why_no_map(run: Run) -> str:
    if run.mission.reconstruction.backend == "none":
        return "The mission reconstructs nothing (reconstruction.backend is none)."
    return "The run left no map."


def _panels(run: Run) -> Iterator[Panel]:
    curves, mission, flight = run.curves, run.mission, run.flight
    nothing = "No metrics were recorded."
    recorded = len(curves.get("time_s", ())) > 0
    yield Panel("Importance", figures.importance(curves, mission) if recorded else None, nothing)

    scored = recorded and bool(np.isfinite(curves["f_score_visible"]).any())
    svg = figures.f_scores(curves, content.floor_scores(run)) if scored else None
    yield Panel("Quality of the map", svg, "No F-score: the run had no map or no truth to compare it with.")

    svg = None if flight is None or not len(flight.time_s) else figures.paths(flight, mission)
    yield Panel("Paths from above", svg, "No trajectories were recorded.", tall=svg is not None)

    drones = sorted(drone.id for drone in mission.drones)
    apart = recorded and bool(np.isfinite(curves["min_separation_m"]).any())
    svg = figures.separation(curves, drones, mission.flight.separation_m) if apart else None
    yield Panel("Separation", svg, "One drone: nobody to keep apart from." if len(drones) == 1 else nothing)

    solved = flight is not None and bool((flight.solve_time_s > 0).any())
    svg = figures.solve_times(flight, mission.tick_s) if flight is not None and solved else None
    yield Panel("Quadratic program", svg, "No solve times were recorded.")
