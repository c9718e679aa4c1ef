"""``python -m deploy.bench``: one flight of a study, as `covrecon run` flies it."""

from __future__ import annotations

import argparse
import sys
from datetime import UTC, datetime
from pathlib import Path

from deploy.mission_run import fly
from deploy.progress import PlainDisplay
from protocol.errors import CovreconError
from protocol.guard import require_own_packages
from protocol.mission_file import load_mission


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m deploy.bench")
    parser.add_argument("mission", type=Path)
    parser.add_argument("out", type=Path)
    parsed = parser.parse_args()

    def say(text: str) -> None:
        sys.stdout.write(f"{text}\n")
        sys.stdout.flush()

    try:
        require_own_packages()
        mission = load_mission(parsed.mission)
        return fly(mission, PlainDisplay(say), out=parsed.out, speed="max", started=datetime.now(UTC))
    except CovreconError as error:
        say(str(error))
        return 1


if __name__ == "__main__":
    sys.exit(main())
