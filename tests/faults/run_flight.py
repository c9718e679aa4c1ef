"""A mission flown as ``covrecon run`` flies it, for studies: in lockstep, with real processes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

COMMAND = (sys.executable, "-P", "-c", "from deploy.cli import main; main()", "run", "--headless")


def run_flight(mission: Path) -> Path:
    """The folder of the run, beside the mission's file. Raises `SystemExit` with what one said that failed."""
    ran = subprocess.run(
        [*COMMAND, str(mission), "--out", str(mission.parent)],
        check=False,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    if ran.returncode:
        raise SystemExit(f"{mission.parent}: the flight failed\n{ran.stdout[-3000:]}")
    return (mission.parent / "latest").resolve()
