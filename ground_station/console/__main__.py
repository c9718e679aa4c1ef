"""``python -m ground_station.console``: the console's process."""

from __future__ import annotations

import sys

from ground_station.console.console import run_console
from protocol.process import Arguments, run_process


async def main(arguments: Arguments) -> None:
    await run_console(arguments.mission, arguments.link, arguments.run, lockstep=arguments.lockstep)


if __name__ == "__main__":
    sys.exit(run_process("ground_station.console", main))
