"""``covrecon plan``: how long a mission takes and how many batteries, before anybody takes off."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Self

from cyclopts import Parameter

if TYPE_CHECKING:
    from deploy.plan_estimate import Plan
    from deploy.progress import Display
    from protocol.messages import Status
    from protocol.mission import Mission


def plan(
    mission: Annotated[Path, Parameter(help="Mission file (TOML).")],
    /,
    *,
    drones: Annotated[int | None, Parameter(help="Team size, as for covrecon run.")] = None,
    seed: Annotated[int | None, Parameter(help="Replaces the mission's seed.")] = None,
    picture: Annotated[Path | None, Parameter(show_default=False)] = None,
    as_json: Annotated[bool, Parameter(name="--json", negative="", show_default=False)] = False,
) -> int:
    """Say how long a mission takes, how many batteries each drone needs, and when it swaps them; and draw it.

    The mission is flown virtually: the same processes in lockstep, without images, as fast as it goes. Without images
    the map's feedback does not raise J, and nothing is in the way; in flight it takes longer. Exit code 1: it does not
    come to its J, or a battery does not take its drone home.

    ```
    covrecon plan my.toml                          # and the picture my-plan.png
    covrecon plan my.toml --drones 4 --json
    ```

    Parameters
    ----------
    picture
        Where the picture goes; without, beside the shell, named after the mission.
    as_json
        The same figures for machines.
    """
    from deploy.plan_estimate import describe, require_way_down, virtual
    from protocol.mission_file import load_mission

    checked = virtual(load_mission(mission, drones=drones, seed=seed))
    require_way_down(checked)
    path = picture or Path(f"{checked.name}-plan.png")
    made = _fly(checked, _display(checked), path)
    if as_json:
        sys.stdout.write(json.dumps({**made.as_json(), "picture": str(path)}, indent=2) + "\n")
    else:
        sys.stdout.write("\n".join([*describe(made), f"picture: {path}"]) + "\n")
    for fault in made.faults:
        sys.stderr.write(fault + "\n")
    return 1 if made.faults else 0


def _display(mission: Mission) -> Display:
    """On stderr, so that stdout has the plan alone."""
    from rich.console import Console

    from deploy.progress import LiveDisplay, PlainDisplay

    terminal = Console(stderr=True, highlight=False)
    if terminal.is_terminal:
        return LiveDisplay(terminal, mission)
    return PlainDisplay(lambda text: print(text, file=sys.stderr, flush=True))


class _Progress:
    """Shows what a run says, but for where its ``folder`` is: this flight leaves none."""

    def __init__(self, display: Display, folder: str) -> None:
        self._display, self._folder = display, folder
        self.said: list[str] = []

    def show(self, status: Status) -> None:
        self._display.show(status)

    def say(self, text: str) -> None:
        self.said.append(text)
        if self._folder not in text:
            self._display.say(text)

    def __enter__(self) -> Self:
        self._display.__enter__()
        return self

    def __exit__(self, *raised: object) -> None:
        self._display.__exit__(*raised)


def _fly(mission: Mission, display: Display, picture: Path) -> Plan:
    """Raises `ProcessError` when the virtual flight fails."""
    from datetime import UTC, datetime
    from tempfile import TemporaryDirectory

    from deploy.mission_run import fly
    from deploy.plan_estimate import estimate
    from deploy.plan_picture import draw_plan
    from ground_station.report.run_folder import load_run
    from protocol.errors import ProcessError

    with TemporaryDirectory(prefix="covrecon-plan-") as folder:
        progress = _Progress(display, folder)
        result = fly(mission, progress, out=Path(folder), speed="max", started=datetime.now(UTC))
        if result != 0:
            raise ProcessError("\n".join(["the virtual flight failed:", *progress.said]))
        run = load_run((Path(folder) / "latest").resolve())
        made = estimate(run)
        if run.flight is not None:
            draw_plan(made, run, run.flight, picture)
    return made
