"""``python -m deploy.compilation MISSION``: numba compiles here what the processes will run, so that none has to in its
first minute. For images and freshly installed computers; it needs no more than a drone has."""

from __future__ import annotations

import sys
from pathlib import Path

from deploy.mission_run import compile_everything
from protocol.mission_file import load_mission

if __name__ == "__main__":
    compile_everything(load_mission(Path(sys.argv[1])))
