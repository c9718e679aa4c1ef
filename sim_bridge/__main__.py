"""``python -m sim_bridge``: the simulated world's process."""

from __future__ import annotations

import sys

from protocol.process import Arguments, run_process
from sim_bridge.simulator import run_simulator


async def main(arguments: Arguments) -> None:
    await run_simulator(arguments.mission, arguments.link, arguments.run, lockstep=arguments.lockstep)


if __name__ == "__main__":
    sys.exit(run_process("sim_bridge", main))
