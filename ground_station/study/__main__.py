"""``python -m ground_station.study``: the process that makes tables and figures of a study, for ``covrecon bench``.

Alone, because it takes Open3D to draw maps, and the launcher does without.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from ground_station.study.document import put_into, write_study
from protocol.errors import CovreconError


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m ground_station.study")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--page", type=Path, help="put the results into this page too")
    parsed = parser.parse_args(arguments)
    try:
        written = write_study(parsed.folder)
        if parsed.page is not None:
            put_into(parsed.page, parsed.folder)
    except CovreconError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    sys.stdout.write(f"results: {written}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
