"""From a run's folder to one self-contained HTML file that asks the network for nothing."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined

from ground_station.report import content
from ground_station.report.panels import panels
from ground_station.report.picture import oblique_view, png, view_from_above
from ground_station.report.replay_page import replay_page
from ground_station.report.replay_scene import replay_scene
from ground_station.report.run_data import Run
from ground_station.report.run_folder import load_run

REPORT_FILE = "report.html"
PICTURE_FILE = "mesh.png"
REPLAY_FILE = "replay.html"
OBLIQUE_PX = (1100, 570)
"""Width and height; sharp at the widest that the page gets."""
PLAN_PX = 560
SNAPSHOT_PX = (560, 290)


@dataclass(frozen=True, slots=True)
class Snapshot:
    time: str
    note: str
    picture: str
    """A data URL."""


def write_report(source: Path, folder: Path | None = None) -> Path:
    """Write the report of a run's folder, or of a recording alone; gives the page's path.

    Beside ``report.html`` lie ``replay.html``, the flight in 3-D, and ``mesh.png``, if there are a flight and a map.
    From a recording they are named after it. All come into ``folder``, or else to where the source is.
    The same source gives the same bytes.

    Raises:
        MissionError: there is no readable mission.
        CovreconError: any other file is there but cannot be read.
    """
    if source.is_dir():
        run, place, prefix = load_run(source), source, ""
    else:
        from ground_station.report.recorded_run import load_recording

        run, place, prefix = load_recording(source), source.parent, f"{source.stem}."
    place = folder or place
    place.mkdir(parents=True, exist_ok=True)
    scene = replay_scene(run)
    if scene is not None:
        (place / f"{prefix}{REPLAY_FILE}").write_text(replay_page(scene, run.mission), encoding="utf-8")
    oblique = None
    if run.mesh is not None:
        oblique = png(oblique_view(run.mesh, *OBLIQUE_PX))
        (place / f"{prefix}{PICTURE_FILE}").write_bytes(oblique)
    path = place / f"{prefix}{REPORT_FILE}"
    path.write_text(_rendered(run, oblique, f"{prefix}{REPLAY_FILE}" if scene else None), encoding="utf-8")
    return path


def _rendered(run: Run, oblique: bytes | None, replay: str | None) -> str:
    plan = None
    if run.mesh is not None:
        plan = png(view_from_above(run.mesh, run.mission.target.lower_m, run.mission.target.upper_m, PLAN_PX))
    summary = run.summary or {}
    faults, more_faults = content.fault_rows(run)
    template = Environment(
        loader=PackageLoader("ground_station.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    ).get_template("template.html")
    return template.render(
        mission=run.mission,
        exit_reason=summary.get("exit_reason"),
        kpis=content.kpis(run),
        oblique=oblique and _embedded(oblique),
        plan=plan and _embedded(plan),
        no_map=_why_no_map(run),
        growth=list(_growth(run)),
        replay=replay,
        panels=list(panels(run)),
        scores=content.score_rows(run),
        drones=content.drone_rows(run),
        faults=faults,
        more_faults=more_faults,
        watched=run.flight is not None or bool(run.history.events),
        notes=run.history.notes,
        hashes=[(name, summary[name]) for name in ("phi_sha256", "mesh_sha256") if summary.get(name)],
        versions=summary.get("versions", {}),
        settings=content.settings(run),
    )


def _growth(run: Run) -> Iterator[Snapshot]:
    """The map as it was, in the frame of the newest one, so that what grows is the map and not the picture."""
    whole = run.mesh or (run.history.maps[-1].mesh if run.history.maps else None)
    for moment in run.history.maps:
        if whole is not None and len(moment.mesh.faces):
            picture = png(oblique_view(moment.mesh, *SNAPSHOT_PX, framed=whole.vertices))
            yield Snapshot(f"{moment.time_s:.0f} s", f"{len(moment.mesh.faces):,} triangles", _embedded(picture))


def _embedded(image: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(image).decode()


def _why_no_map(run: Run) -> str:
    if run.mission.reconstruction.backend == "none":
        return "The mission reconstructs nothing (reconstruction.backend is none)."
    return "The run left no map."
