"""``covrecon doctor``: is this computer fit to fly a mission, and what to do if not."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from cyclopts.validators import Number

from deploy.doctor.finding import Finding

if TYPE_CHECKING:
    from protocol.mission import Mission

STYLES = {"ok": "green", "warn": "yellow", "fail": "bold red"}


def doctor(
    mission: Annotated[Path | None, Parameter(help="Mission file (TOML); without one, the default settings.")] = None,
    /,
    *,
    drones: Annotated[
        int | None, Parameter(help="Team size, as for covrecon run.", validator=Number(gte=1, lte=255))
    ] = None,
    drone: Annotated[
        int, Parameter(help="Judge this computer as that drone's own.", validator=Number(gte=0, lte=255))
    ] = 0,
    out: Annotated[Path, Parameter(help="Where run folders would be made.")] = Path("runs"),
    as_json: Annotated[bool, Parameter(name="--json", negative="", show_default=False)] = False,
) -> int:
    """Say whether this computer can fly a mission, and what to do where it cannot. Nothing is changed.

    Looks at libraries, ports, certificates, clock, disk, memory, processor, GPU, and who could reach the processes from
    elsewhere. "warn" flies, but worse or less safely. Exit code 1 if anything fails.

    ```
    covrecon doctor                                   # with the default settings
    covrecon doctor missions/px4.toml                 # with what this mission wants
    covrecon doctor missions/demo.toml --drones 8 --json
    covrecon doctor fleet.toml --drone 3              # on the computer that drone 3 carries
    ```

    Parameters
    ----------
    as_json
        A list of objects with subject, level, text and advice, for machines.
    """
    from deploy.doctor.examination import examine

    findings = []
    for finding in examine(_mission(mission, drones), out, drone):
        findings.append(finding)
        if not as_json:
            _show(finding)
    failed = sum(finding.level == "fail" for finding in findings)
    if as_json:
        sys.stdout.write(json.dumps([asdict(finding) for finding in findings], indent=2) + "\n")
    else:
        warned = sum(finding.level == "warn" for finding in findings)
        sys.stdout.write(f"{failed} to mend, {warned} to know of, {len(findings) - failed - warned} well\n")
    return 1 if failed else 0


def _mission(path: Path | None, drones: int | None) -> Mission:
    """The file's mission; without a file, what a mission that says nothing would be."""
    from protocol.formation import formation
    from protocol.mission import Drone, Flight, Mission
    from protocol.mission_file import load_mission

    if path is not None:
        return load_mission(path, drones=drones)
    starts = formation(Flight(), drones or 1, [])
    return Mission(drones=tuple(Drone(id=number, start=start) for number, start in enumerate(starts, start=1)))


def _show(finding: Finding) -> None:
    from rich.console import Console
    from rich.text import Text

    console = Console(highlight=False)
    line = Text.assemble((f"{finding.level:5}", STYLES[finding.level]), f"{finding.subject:20} {finding.text}")
    console.print(line, soft_wrap=True)
    if finding.advice:
        console.print(Text(f"{'':25} -> {finding.advice}"), soft_wrap=True)
