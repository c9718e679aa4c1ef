"""``python -m sim_bridge.training_rooms``: the process that furnishes rooms, for ``covrecon train``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from protocol.errors import CovreconError
from sim_bridge.training_rooms.room_file import write_room


def main(arguments: list[str] | None = None) -> int:
    """One line on the standard output for each room that is there, as soon as it is."""
    parser = argparse.ArgumentParser(prog="python -m sim_bridge.training_rooms")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", required=True)
    parser.add_argument("--voxel", type=float, required=True, help="spacing of the lattice, metres")
    parser.add_argument("--reach", type=float, required=True, help="distances are cut here, metres")
    parsed = parser.parse_args(arguments)
    try:
        for seed in parsed.seeds:
            path = parsed.folder / f"room-{seed}.npz"
            if not path.exists():
                write_room(path, seed, parsed.voxel, parsed.reach)
            sys.stdout.write(f"{path.name}\n")
            sys.stdout.flush()
    except (CovreconError, OSError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
