"""``python -m faults.other_release minor|major MODULE ...``: a process as another release of this program has it.

``minor``: of the next minor version, whose drones say something new with each state. ``major``: of the next major one.
"""

from __future__ import annotations

import runpy
import sys

from protocol import messages, wire


class DroneState(messages.DroneState):
    """With a field of later."""

    wind_mps: float = 3.5


def become(kind: str, module: str, arguments: list[str]) -> None:
    if kind == "major":
        wire.WIRE_VERSION += 1
    else:
        wire.WIRE_MINOR += 1
        messages.DroneState = DroneState  # type: ignore[misc]  # before anybody has imported it
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    become(sys.argv[1], sys.argv[2], sys.argv[3:])
