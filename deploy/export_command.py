"""``covrecon export``: what was flown and mapped, in the formats of other programs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter
from cyclopts.validators import Number

if TYPE_CHECKING:
    from ground_station.export.output import Exported
    from ground_station.export.source import Progress, Source

export_app = App(
    name="export",
    help="""Write what was flown and mapped in the formats of other programs.

    All are made from a run's folder, also of a run that goes on or was cut short, or from a recording; neither is
    changed. World frame: x east, y north, z up, metres. If the mission has vehicles.origin, georeference.json is
    written beside.
    """,
)

RunPath = Annotated[Path, Parameter(help="A run's folder, or a recording (.mcap).")]
Out = Annotated[
    Path | None,
    Parameter(help="Where to write; by default export/ in the run's folder, or beside the recording."),
]
Force = Annotated[
    bool,
    Parameter(negative="", show_default=False, help="Write into a folder that holds something; replaces same names."),
]
SparsePoints = Annotated[
    int, Parameter(validator=Number(gte=0), help="Points drawn from the map, to begin from; 0 for none.")
]

LATEST = Path("runs/latest")


@export_app.command
def nerfstudio(
    run: RunPath = LATEST, /, *, out: Out = None, points: SparsePoints = 50_000, force: Force = False
) -> None:
    """Keyframes and poses as nerfstudio's transforms.json, with images and points to begin from.

    Example: covrecon export nerfstudio runs/latest --out garden
    """
    from ground_station.export.nerfstudio import export_nerfstudio

    _export(run, out, "nerfstudio", force, partial(export_nerfstudio, points=points))


@export_app.command
def colmap(run: RunPath = LATEST, /, *, out: Out = None, points: SparsePoints = 50_000, force: Force = False) -> None:
    """Keyframes and poses as a COLMAP text model: images/ and sparse/0/.

    With vehicles.origin in the mission, geo.txt has the images' places for colmap model_aligner.

    Example: covrecon export colmap recording.mcap --out garden
    """
    from ground_station.export.colmap import export_colmap

    _export(run, out, "colmap", force, partial(export_colmap, points=points))


@export_app.command
def mesh(
    run: RunPath = LATEST,
    /,
    *,
    out: Out = None,
    formats: Annotated[
        tuple[Literal["ply", "glb", "obj"], ...], Parameter(name="--format", negative="", help="May be repeated.")
    ] = ("ply", "glb", "obj"),
    force: Force = False,
) -> None:
    """The map with vertex colours. PLY and OBJ have z up; GLB has y up, as glTF demands.

    Example: covrecon export mesh runs/latest --format glb --out garden
    """
    from ground_station.export.maps import export_mesh

    _export(run, out, "mesh", force, partial(export_mesh, formats=formats))


@export_app.command
def cloud(
    run: RunPath = LATEST,
    /,
    *,
    out: Out = None,
    points: Annotated[int, Parameter(validator=Number(gte=1), help="How many.")] = 200_000,
    force: Force = False,
) -> None:
    """Points spread evenly over the map, with normals and colours, as PLY.

    Example: covrecon export cloud runs/latest --points 1000000
    """
    from ground_station.export.maps import export_cloud

    _export(run, out, "cloud", force, partial(export_cloud, points=points))


@export_app.command
def trajectories(
    run: RunPath = LATEST,
    /,
    *,
    out: Out = None,
    formats: Annotated[
        tuple[Literal["csv", "tum"], ...], Parameter(name="--format", negative="", help="May be repeated.")
    ] = ("csv", "tum"),
    force: Force = False,
) -> None:
    """What each drone flew: tables (CSV), and camera poses in TUM's format for evo.

    CSV has a row for each tick and drone: pose, latitude and longitude with vehicles.origin, and how its controller
    fared. TUM has the camera's optical frame: x right, y down, z forward.

    Example: covrecon export trajectories runs/latest --format tum
    """
    from ground_station.export.flights import export_flight

    _export(run, out, "trajectories", force, partial(export_flight, formats=formats))


@export_app.command
def phi(
    run: RunPath = LATEST,
    /,
    *,
    out: Out = None,
    formats: Annotated[
        tuple[Literal["npz", "vtk"], ...], Parameter(name="--format", negative="", help="May be repeated.")
    ] = ("npz", "vtk"),
    force: Force = False,
) -> None:
    """The importance of all that is to be seen: numpy arrays (NPZ), and an image for ParaView (VTK).

    Example: covrecon export phi runs/latest --format vtk
    """
    from ground_station.export.importance_files import export_importance

    _export(run, out, "phi", force, partial(export_importance, formats=formats))


def _export(run: Path, out: Path | None, kind: str, force: bool, write: Callable[[Source, Path], Exported]) -> None:
    """Open, write and tell."""
    from ground_station.export.output import output_folder
    from ground_station.export.source import open_source

    with _shown() as progress:
        source = open_source(run.resolve(), progress)
        with output_folder(out or _beside(source.path) / kind, force=force) as folder:
            exported = write(source, folder)
    for note in exported.notes:
        print(note)
    print(f"{exported.content}: {exported.folder}")


def _beside(source: Path) -> Path:
    return source / "export" if source.is_dir() else source.with_name(f"{source.stem}-export")


@contextmanager
def _shown() -> Iterator[Progress]:
    """A bar on the terminal, if there is one."""
    from rich import progress as rich_progress
    from rich.console import Console

    console = Console(stderr=True)
    with rich_progress.Progress(console=console, transient=True, disable=not console.is_terminal) as bars:
        tasks: dict[str, rich_progress.TaskID] = {}

        def show(what: str, done: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = bars.add_task(what, total=total)
            bars.update(tasks[what], completed=done)

        yield show
