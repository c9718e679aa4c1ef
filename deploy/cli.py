"""The command ``covrecon``.

Exit codes: 0 all went well, 1 something failed, 2 bad input; 128 + n after signal n. Commands import what they need
when they run, so that help and completion answer at once.
"""

from __future__ import annotations

import os
import shlex
import sys
from pathlib import Path
from typing import Annotated, Literal, NoReturn

from cyclopts import App, Parameter
from cyclopts.validators import Number

from deploy.bench_command import bench_app
from deploy.completion_command import completion_of
from deploy.doctor_command import doctor
from deploy.evaluate_command import evaluate
from deploy.export_command import export_app
from deploy.pki_command import pki_app
from deploy.plan_command import plan
from deploy.reconstruct_command import reconstruct
from deploy.recording_command import recording_app
from deploy.replay_command import replay
from deploy.traffic_command import traffic
from deploy.train_command import train
from protocol.errors import CovreconError, CredentialsError, MissionError, SceneError
from protocol.guard import require_own_packages
from protocol.verbs import Verb


def _version() -> str:
    from importlib.metadata import version

    return version("coverage-recon")


app = App(
    name="covrecon",
    help="Drones that photograph a scene, map it while flying, and fly on to where the map changes.",
    help_epilogue="Begin with: covrecon doctor, then covrecon run missions/demo.toml",
    version=_version,
)
mission_app = App(name="mission", help="Check and show mission files. Example: covrecon mission check workshop.toml")
app.command(mission_app)
app.command(recording_app)
app.command(export_app)
app.command(pki_app)
app.command(bench_app)
app.command(plan)
app.command(replay)
app.command(evaluate)
app.command(reconstruct)
app.command(doctor)
app.command(traffic)
app.command(train)
app.command(completion_of(app), name="completion")

MissionPath = Annotated[Path, Parameter(help="Mission file (TOML).")]
TeamSize = Annotated[int | None, Parameter(help="Team size; drones that the file does not place start in a grid.")]
Seed = Annotated[int | None, Parameter(help="Replaces the mission's seed.")]


def main() -> NoReturn:
    """Entry point: every error raised on purpose ends in its message alone."""
    try:
        require_own_packages()
        result = app(result_action="return_value")
    except (MissionError, SceneError, CredentialsError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    except CovreconError as error:
        print(error, file=sys.stderr)
        sys.exit(1)
    sys.exit(result)


@app.command
def run(
    mission: MissionPath,
    /,
    *,
    drones: TeamSize = None,
    speed: Literal["max", "1"] = "max",
    headless: Annotated[bool, Parameter(negative="", show_default=False)] = False,
    seed: Seed = None,
    restart: Annotated[int, Parameter(validator=Number(gte=0))] = 0,
    vehicles: Annotated[Literal["simulated", "px4", "px4-endpoint"] | None, Parameter(show_default=False)] = None,
    px4_url: Annotated[str | None, Parameter(show_default=False)] = None,
    console: Annotated[bool, Parameter(negative="", show_default=False)] = False,
    wait: Annotated[bool, Parameter(negative="", show_default=False)] = False,
    foxglove: Annotated[int | None, Parameter(show_default=False)] = None,
    metrics: Annotated[int | None, Parameter(show_default=False)] = None,
    mapper: Annotated[str, Parameter(show_default=False)] = "",
    out: Path = Path("runs"),
) -> int:
    """Fly a mission: router, simulator, ground station and one process a drone, all on this machine.

    ```
    covrecon run missions/demo.toml                          # as fast as it goes, the same result each time
    covrecon run missions/demo.toml --drones 2 --seed 8      # another team, another seed
    covrecon run my.toml --speed 1 --console --wait          # real time; the page has the start button
    covrecon run missions/px4.toml --vehicles px4-endpoint   # PX4-like vehicles, started with it
    ```

    Parameters
    ----------
    speed
        "max": as fast as the machine allows, the same seed gives the same result. "1": real time, as PX4 always flies.
    headless
        Plain lines instead of the live table.
    restart
        How often each process but the simulator is started again when it dies.
    vehicles
        What carries the drones, instead of what the mission says: the internal simulator; PX4, hardware or SITL, that
        is running already (docs/px4.md); or PX4-like vehicles of our own, started with the run.
    px4_url
        MAVSDK connection of the first PX4; each next one is at the next port.
    console
        Serve a page to watch and command the mission; its address, with a token, is printed.
    wait
        Stay on the ground until an operator says "start", in the console or by `covrecon command start`.
    foxglove
        Port at which Foxglove may watch on this computer, 8765 for example.
    metrics
        First port of the Prometheus endpoints on this computer.
    mapper
        Command of a process of your own that makes the map, started with the run (docs/external-reconstructor.md).
    out
        Where the run's folder is made.
    """
    from datetime import UTC, datetime

    from rich.console import Console

    from deploy.mission_run import fly
    from deploy.progress import LiveDisplay, PlainDisplay
    from protocol.mission_file import load_mission

    chosen = {
        "vehicles.kind": vehicles and ("simulated" if vehicles == "simulated" else "px4"),
        "vehicles.url": px4_url,
        "start": "on_command" if wait else None,
        "recording.foxglove_port": foxglove,
        "metrics.port": metrics,
        "reconstruction.backend": "external" if mapper else None,
    }
    replaced = {name: value for name, value in chosen.items() if value is not None}
    checked = load_mission(mission, drones=drones, seed=seed, replaced=replaced)
    terminal = Console(highlight=False)
    display = (
        LiveDisplay(terminal, checked)
        if terminal.is_terminal and not headless
        else PlainDisplay(lambda text: print(text, flush=True))
    )
    return fly(
        checked,
        display,
        out=out,
        speed=speed,
        started=datetime.now(UTC),
        restarts=restart,
        with_autopilots=vehicles == "px4-endpoint",
        with_console=console,
        mapper=shlex.split(mapper),
    )


@app.command
def report(run: Annotated[Path, Parameter(help="A run's folder, or a recording.")] = Path("runs/latest"), /) -> None:
    """Write a run's report anew, also that of a run which was cut short, or the report of any recording.

    ```
    covrecon report                              # of the newest run, runs/latest
    covrecon report runs/2026-08-01T09-30-00Z
    covrecon report flight.mcap                  # of a recording alone
    ```
    """
    from deploy.outcome import SUMMARY_FILE, describe, read_outcome
    from ground_station.report import write_report

    page = write_report(run.resolve())
    if run.is_file():
        print(f"report: {page}")
        return
    if (page.parent / SUMMARY_FILE).exists():
        for line in describe(read_outcome(page.parent), page.parent):
            print(line)
    else:
        print(f"the run was cut short; report: {page}")


@app.command
def command(
    verb: Verb,
    /,
    *,
    drone: Annotated[tuple[int, ...], Parameter(help="Only this one; may be repeated. All without.")] = (),
    run: Annotated[Path, Parameter(help="The folder of the run that flies.")] = Path("runs/latest"),
    mission: Annotated[Path | None, Parameter(help="Instead of a run: the mission file, on another computer.")] = None,
    operator: Annotated[str, Parameter(help="Whose certificate to show, where there are several.")] = "",
    patience: Annotated[float, Parameter(help="Seconds to wait for all acknowledgements.")] = 10.0,
) -> None:
    """Command a mission that flies, and wait until every drone has acknowledged it.

    start: a mission that waits for it (`covrecon run --wait`). pause, resume: hold the place, go on. return: fly to the
    start and land. land: come down here. abort: all land, and the mission ends.

    ```
    covrecon command pause
    covrecon command land --drone 3
    covrecon command return --drone 1 --drone 4 --run runs/2026-08-01T09-30-00Z
    covrecon command pause --mission fleet.toml --operator anna   # from a laptop with a certificate
    ```
    """
    import asyncio

    from deploy.command_client import command as insist
    from deploy.command_client import place_of, place_of_mission

    place = place_of(run) if mission is None else place_of_mission(mission, operator)
    asyncio.run(insist(place, verb, drone, say=print, patience_s=patience))


@mission_app.command
def check(mission: MissionPath, /, *, drones: TeamSize = None) -> None:
    """Say all that is wrong with a mission file, each fault with its line.

    Example: covrecon mission check workshop.toml --drones 4
    """
    from ground_station.reconstruction.learned.requirements import require_backend
    from protocol.mission_file import load_mission

    checked = load_mission(mission, drones=drones)
    require_backend(checked)
    print(f"{mission}: {checked.name} is ready to fly, drones: {len(checked.drones)}")


@mission_app.command
def show(mission: MissionPath, /, *, drones: TeamSize = None, seed: Seed = None) -> None:
    """Print the effective mission, every default spelt out, as a mission file.

    Example: covrecon mission show missions/demo.toml --drones 6 > six.toml
    """
    from protocol.mission_file import load_mission, mission_to_toml

    print(mission_to_toml(load_mission(mission, drones=drones, seed=seed)), end="")


@mission_app.command
def schema() -> None:
    """Print the JSON schema of mission files, for editors.

    Example: covrecon mission schema > mission.schema.json
    """
    from protocol.mission_file import mission_schema

    print(mission_schema(), end="")


@mission_app.command(name="router-config")
def router_config(mission: MissionPath, /) -> None:
    """Print the configuration with which zenoh's own router does what `covrecon router` does, access control included.

    It holds who is admitted now: print it again when certificates were issued or revoked, and start the router again.

    ```
    covrecon mission router-config fleet.toml > router.json5
    zenohd -c router.json5
    ```
    """
    import json
    from datetime import UTC, datetime

    from protocol.credentials import ROUTER, load_register
    from protocol.links import link_of
    from protocol.mission_file import load_mission
    from protocol.router import access_rules
    from protocol.session import configuration, require_safe

    checked = load_mission(mission)
    link = link_of(checked, ROUTER)
    require_safe(link, checked.transport.uplinks)
    access = None
    if link.credentials is not None:
        access = access_rules(checked, load_register(link.credentials.folder).admitted(datetime.now(UTC)))
    told = configuration("router", link, checked.name, uplinks=checked.transport.uplinks, access=access)
    print(json.dumps(told, indent=2))


def _process(command: str, module: str, what: str) -> None:
    """Let ``covrecon COMMAND`` become ``python -m MODULE``, which has its own options and help."""

    def become(*arguments: Annotated[str, Parameter(allow_leading_hyphen=True)]) -> NoReturn:
        from deploy.local import environment

        # -P keeps the current folder from shadowing a package.
        argv = [sys.executable, "-P", "-m", module, *arguments]
        os.execve(sys.executable, argv, environment(os.environ))  # noqa: S606  # the arguments are the caller's own

    app.command(
        become, name=command, help=f"Start {what} alone; its options: covrecon {command} --help.", help_flags=()
    )


_process("agent", "agents", "one drone")
_process("console", "ground_station.console", "the page in the browser")
_process("ground", "ground_station", "the ground station")
_process("mocap", "ground_station.motion_capture", "the bridge from a motion capture system")
_process("router", "protocol.router", "the router")
_process("sim", "sim_bridge", "the simulator")
_process("px4-endpoint", "sim_bridge.px4_endpoint", "PX4-like vehicles that speak MAVLink")
