"""``python -m agents``: one drone's process."""

from __future__ import annotations

import sys

from agents.agent import run_agent
from protocol.process import Arguments, run_process


async def main(arguments: Arguments) -> None:
    await run_agent(arguments.mission, arguments.drone, arguments.link, lockstep=arguments.lockstep)


if __name__ == "__main__":
    sys.exit(run_process("agents", main))
