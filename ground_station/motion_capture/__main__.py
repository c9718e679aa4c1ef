"""``python -m ground_station.motion_capture``: what passes on the poses of a motion capture system."""

from __future__ import annotations

import sys

from ground_station.motion_capture.bridge import run_bridge
from protocol.process import Arguments, run_process


async def main(arguments: Arguments) -> None:
    await run_bridge(arguments.mission, arguments.link)


if __name__ == "__main__":
    sys.exit(run_process("ground_station.motion_capture", main))
