"""``covrecon bench``: studies of many flights, for those who compare."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter
from cyclopts.validators import Number

if TYPE_CHECKING:
    from deploy.bench.executors import Executor
    from deploy.bench.plan import Job, Wish
    from deploy.bench.progress import Tally, Watch
    from deploy.bench.rooms import MapJob
    from ground_station.study.plan_file import Study

bench_app = App(
    name="bench",
    help="""Fly many missions to compare methods, and make tables and figures of them.

    Flights are real ones in lockstep, as many at once as there are cores. After an interrupt the same command goes on:
    what was flown to its end is not flown again, unless settings or versions differ.
    """,
)

Which = Literal["lawnmower", "persistent", "angle_aware_down", "angle_aware", "none", "grid", "m3c2"]
Positive = Number(gt=0)
AtLeastOne = Number(gte=1)
Share = Number(gte=0, lte=1)

Seeds = Annotated[int | None, Parameter(validator=AtLeastOne, help="Flights of each kind, with seeds from 1 on.")]
Duration = Annotated[float | None, Parameter(validator=Positive, help="Mission time of each flight, in seconds.")]
MissionFile = Annotated[Path, Parameter(help="What is flown, but for what is compared.")]
Settings = Annotated[
    tuple[str, ...],
    Parameter(name="--set", negative="", help="Changes a setting in all flights, like feedback.kappa=0.5; repeatable."),
]
Jobs = Annotated[int | None, Parameter(validator=AtLeastOne, help="Flights at a time; all cores without.")]
Place = Annotated[Literal["local", "ray"], Parameter(help="Fly on this machine, or on a Ray cluster (extra cluster).")]
RayAddress = Annotated[str | None, Parameter(help="Of a Ray cluster that runs; without, one of this machine's cores.")]
ReportOnly = Annotated[bool, Parameter(negative="", help="Fly nothing: tables and figures of what is flown.")]
Page = Annotated[Path | None, Parameter(help="Put the results into this page of Markdown too, between its comments.")]

PAPER_MISSION = Path("missions/paper.toml")
PAPER_SEEDS, PAPER_DURATION_S = 3, 900.0
QUICK_SEEDS, QUICK_DURATION_S = 1, 200.0
"""Long enough for feedback, which begins after some 100 s of one drone's flight."""
FEEDBACK_SEEDS, FEEDBACK_DURATION_S = 5, 600.0
QUICK_ROOMS = 2
FLYING = "flying"
"""Folder of what flies at the moment, in the study's."""
MAPS_WORDS = ("maps made", "being made")


@bench_app.command
def paper(
    *,
    quick: Annotated[bool, Parameter(negative="")] = False,
    seeds: Seeds = None,
    duration: Duration = None,
    methods: Annotated[tuple[Which, ...], Parameter(negative="", consume_multiple=True)] = (),
    mission: MissionFile = PAPER_MISSION,
    settings: Settings = (),
    out: Path = Path("benches/paper"),
    jobs: Jobs = None,
    executor: Place = "local",
    ray_address: RayAddress = None,
    report_only: ReportOnly = False,
    page: Page = None,
) -> int:
    """Every method of the paper in one table: quality of the map, time to J, path, separation, cost of feedback.

    Each method with one drone, grid feedback also with two and four, and with J_th of 30 and 70 %.

    ```
    covrecon bench paper                                     # 3 seeds of 900 s each: some hours
    covrecon bench paper --quick                             # one seed of 200 s: some minutes
    covrecon bench paper --methods none grid --seeds 10
    covrecon bench paper --report-only                       # tables and figures anew from what is flown
    ```

    Parameters
    ----------
    quick
        One seed and short flights.
    methods
        Only these.
    out
        The study's folder, that holds flights, tables and figures.
    """
    from deploy.bench.plan import ALL_METHODS, paper_jobs

    seeds = seeds or (QUICK_SEEDS if quick else PAPER_SEEDS)
    duration = duration or (QUICK_DURATION_S if quick else PAPER_DURATION_S)
    if report_only:
        return _report(out, page)
    wish = _wish(mission, duration, seeds, settings)
    planned = paper_jobs(wish, methods or ALL_METHODS)
    return _study("paper", wish, planned, out, jobs, executor, ray_address, page)


@bench_app.command
def feedback(
    *,
    seeds: Seeds = FEEDBACK_SEEDS,
    duration: Duration = FEEDBACK_DURATION_S,
    scenes: Annotated[tuple[str, ...], Parameter(negative="", consume_multiple=True)] = ("living_room", "room-1"),
    mission: MissionFile = PAPER_MISSION,
    settings: Settings = (),
    out: Path = Path("benches/feedback"),
    jobs: Jobs = None,
    executor: Place = "local",
    ray_address: RayAddress = None,
    report_only: ReportOnly = False,
    page: Page = None,
) -> int:
    """Does feedback help? F with grid feedback minus F without, at equal flight time, with a confidence interval.

    ```
    covrecon bench feedback                                  # 5 seeds in 2 scenes, 600 s each
    covrecon bench feedback --set feedback.kappa=0.5 --out benches/kappa
    ```

    Parameters
    ----------
    scenes
        As in a mission file; a path is relative to the mission.
    out
        The study's folder, that holds flights, tables and figures.
    """
    from deploy.bench.plan import feedback_jobs

    if report_only:
        return _report(out, page)
    wish = _wish(mission, duration or FEEDBACK_DURATION_S, seeds or FEEDBACK_SEEDS, settings)
    planned = feedback_jobs(wish, scenes)
    return _study("feedback", wish, planned, out, jobs, executor, ray_address, page)


@bench_app.command
def reconstruction(
    *,
    quick: Annotated[bool, Parameter(negative="")] = False,
    rooms: Annotated[int, Parameter(validator=AtLeastOne)] = 10,
    contrasts: Annotated[tuple[float, ...], Parameter(negative="", consume_multiple=True, validator=Share)] = (
        1.0,
        0.25,
        0.1,
    ),
    backends: Annotated[tuple[str, ...], Parameter(negative="", consume_multiple=True)] = ("plane_sweep",),
    mission: MissionFile = PAPER_MISSION,
    settings: Settings = (),
    out: Path = Path("benches/reconstruction"),
    jobs: Jobs = None,
    report_only: ReportOnly = False,
    page: Page = None,
) -> int:
    """How good are maps of rooms that nothing was tuned on? Each room is flown once under each texture, and every
    backend makes its map of the same keyframes.

    Four drones without feedback fly until J is below 0.05. Flights keep their keyframes, some 40 MB each.

    ```
    covrecon bench reconstruction                                       # 10 rooms, three textures: half an hour
    covrecon bench reconstruction --quick                               # two rooms
    covrecon bench reconstruction --backends plane_sweep plane_sweep:high depth
    covrecon bench reconstruction --set reconstruction.voxel_m=0.02     # other maps of the same flights
    ```

    Parameters
    ----------
    quick
        Two rooms.
    rooms
        How many; the first is room-901, and those from there on are for this alone.
    contrasts
        Of the textures: 1 as drawn, 0 plain colours.
    backends
        As in reconstruction.backend, or with a quality of `covrecon reconstruct` behind a colon. One that cannot
        make a map of these keyframes is left out, and the table says why.
    out
        The study's folder, that holds flights, maps, tables and figures.
    """
    from deploy.bench.executors import LocalExecutor
    from deploy.bench.flight import KEPT_TO_MAP
    from deploy.bench.plan import cores, plan_of
    from deploy.bench.rooms import LONGEST_S, map_jobs, room_jobs
    from ground_station.study.plan_file import write_plan

    if report_only:
        return _report(out, page)
    wish = _wish(mission, LONGEST_S, QUICK_ROOMS if quick else rooms, settings)
    flights = room_jobs(wish, contrasts)
    maps = map_jobs(flights, backends, wish.settings)
    write_plan(out, plan_of("reconstruction", wish, flights, _command(), [job.planned for job in maps]))
    slots = jobs or cores()
    code = _fly(out, wish, flights, LocalExecutor(slots, out / FLYING, KEPT_TO_MAP))
    if code > 1:
        return code
    made = _make_maps(out, maps, slots)
    return made if made > 1 else max(code, made, _report(out, page))


def _wish(mission: Path, duration_s: float, seeds: int, settings: Sequence[str]) -> Wish:
    from deploy.bench.plan import Wish, assignments

    return Wish(mission, duration_s, seeds, assignments(settings))


def _study(
    study: Study,
    wish: Wish,
    jobs: Sequence[Job],
    out: Path,
    slots: int | None,
    place: Literal["local", "ray"],
    ray_address: str | None,
    page: Path | None,
) -> int:
    """Fly what is left and tell; an exit code."""
    from deploy.bench.executors import LocalExecutor
    from deploy.bench.plan import cores, plan_of
    from ground_station.study.plan_file import write_plan

    write_plan(out, plan_of(study, wish, jobs, _command()))
    executor: Executor
    if place == "ray":
        from deploy.bench.ray_executor import RayExecutor

        executor = RayExecutor(ray_address, slots)
    else:
        executor = LocalExecutor(slots or cores(), out / FLYING)
    code = _fly(out, wish, jobs, executor)
    # What flew is told, also beside flights that failed; not after an interrupt, for whoever did that wants to leave.
    return code if code > 1 else max(code, _report(out, page))


def _fly(out: Path, wish: Wish, jobs: Sequence[Job], executor: Executor) -> int:
    """What is left; an exit code, over 1 after an interrupt."""
    import asyncio

    from deploy.bench.campaign import fly_all, left_of
    from deploy.bench.progress import Tally
    from deploy.mission_run import compile_everything

    left = left_of(out, jobs)
    if not left:
        return 0
    tally = Tally.of([job.planned for job in jobs], [job.planned for job in left], wish.duration_s)
    with _watch(tally) as watch:
        watch.say(f"{len(left)} of {len(jobs)} flights to fly, into {out}")
        compile_everything(left[0].mission)  # here once, and not in all of the first flights at the same time
        return asyncio.run(fly_all(out, left, executor, watch))


def _make_maps(out: Path, maps: Sequence[MapJob], slots: int) -> int:
    """Of the flights that are flown; an exit code, over 1 after an interrupt."""
    import asyncio

    from deploy.bench.maps import make_maps, maps_left
    from deploy.bench.progress import Tally

    left = maps_left(out, maps)
    if not left:
        return 0
    tally = Tally({job.planned.name: 1.0 for job in left}, len(maps) - len(left), len(maps), words=MAPS_WORDS)
    with _watch(tally) as watch:
        watch.say(f"{len(left)} of {len(maps)} maps to make, into {out}")
        return asyncio.run(make_maps(out, left, slots, watch))


def _watch(tally: Tally) -> Watch:
    from rich.console import Console

    from deploy.bench.progress import LiveWatch, PlainWatch

    terminal = Console(highlight=False)
    if terminal.is_terminal:
        return LiveWatch(tally, terminal)
    return PlainWatch(tally, lambda text: print(text, flush=True))


def _command() -> str:
    """By which this study is flown, for people."""
    return shlex.join(["covrecon", *sys.argv[1:]])


def _report(folder: Path, page: Path | None) -> int:
    """By a process of the ground station's, which may draw maps."""
    import os
    import subprocess

    from deploy.local import environment

    # -P keeps the current folder from shadowing a package.
    argv = [sys.executable, "-P", "-m", "ground_station.study", str(folder.resolve())]
    argv += ["--page", str(page.resolve())] if page is not None else []
    return subprocess.run(argv, env=environment(os.environ), check=False).returncode
