"""``python -m ground_station.reconstruction.learned.training``: the process that learns, for ``covrecon train``.

Alone, because it takes torch, and the launcher does without.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from ground_station.reconstruction.learned.requirements import require_torch
from ground_station.reconstruction.learned.training.folder import read_settings
from protocol.errors import CovreconError


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m ground_station.reconstruction.learned.training")
    parser.add_argument("folder", type=Path, help="holds settings.json and rooms; gets checkpoint, curve and weights")
    parser.add_argument("--steps", type=int)
    parser.add_argument("--minutes", type=float)
    parser.add_argument("--resume", action="store_true")
    parsed = parser.parse_args(arguments)
    try:
        require_torch()
        from ground_station.reconstruction.learned.training.course import run_course

        settings = read_settings(parsed.folder)
        run_course(settings, parsed.folder, steps=parsed.steps, minutes=parsed.minutes, resume=parsed.resume)
    except CovreconError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
