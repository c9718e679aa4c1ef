"""``python -m sim_bridge.px4_endpoint``: PX4-like vehicles for a mission, as a process that lives until a signal."""

from __future__ import annotations

import argparse
import faulthandler
import logging
import signal
import sys
import threading
import time
from pathlib import Path

from protocol.errors import MissionError
from protocol.guard import require_own_packages
from protocol.mission_file import load_mission
from protocol.process import BAD_INPUT, FAILED, TERMINATED
from sim_bridge.px4_endpoint.endpoint import Endpoint

WRITE_PERIOD_S = 5.0
"""Between two versions of the truth files, so that a killed process leaves one."""
LINGER_S = 2.0
"""Real vehicles do not end with a run: agents that are ended at the same time can still tell theirs to land."""

log = logging.getLogger(__name__)


def parse(arguments: list[str] | None = None) -> tuple[Path, Path]:
    """Mission file and run folder."""
    parser = argparse.ArgumentParser(prog="python -m sim_bridge.px4_endpoint")
    parser.add_argument("--mission", type=Path, required=True, help="mission file, TOML or JSON")
    parser.add_argument("--run", type=Path, required=True, help="folder for vehicles.npz and vehicles.json")
    parser.add_argument("--endpoint", help="as all processes of a mission are given it; not used")
    parser.add_argument("--speed", choices=("max", "1"), help="likewise; these vehicles know real time only")
    parsed = parser.parse_args(arguments)
    return parsed.mission, parsed.run


def fly(endpoint: Endpoint, run: Path, ended: threading.Event) -> int:
    """Until ``ended``, or until a fault ends the vehicles; the exit code. Keeps the truth files fresh."""
    with endpoint:
        for vehicle in endpoint.vehicles.values():
            log.info("drone %d is system %d on %s", vehicle.drone.id, vehicle.link.system, vehicle.link.url)
        while endpoint.running and not ended.wait(WRITE_PERIOD_S):
            endpoint.write(run)
        if ended.is_set():
            time.sleep(LINGER_S)
    endpoint.write(run)
    return TERMINATED if ended.is_set() else FAILED


def main() -> int:
    faulthandler.enable()
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    ended = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda _number, _frame: ended.set())
    try:
        require_own_packages()
        mission, run = parse()
        return fly(Endpoint(load_mission(mission)), run, ended)
    except MissionError as error:
        log.error("%s", error)  # noqa: TRY400  # the fault is in the file, not here
        return BAD_INPUT


if __name__ == "__main__":
    sys.exit(main())
