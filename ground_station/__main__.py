"""``python -m ground_station``: the ground station's process."""

from __future__ import annotations

import sys

from ground_station.ground_station import run_ground_station
from protocol.process import Arguments, run_process


async def main(arguments: Arguments) -> None:
    await run_ground_station(arguments.mission, arguments.link, arguments.run, lockstep=arguments.lockstep)


if __name__ == "__main__":
    sys.exit(run_process("ground_station", main))
