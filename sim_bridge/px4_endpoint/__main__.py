"""``python -m sim_bridge.px4_endpoint``: PX4-like vehicles for a mission, as a process that lives until a signal."""

from __future__ import annotations

import argparse
import asyncio
import faulthandler
import logging
import signal
import sys
import threading
import time
from pathlib import Path

from protocol.credentials import SIM
from protocol.errors import CovreconError, MissionError
from protocol.guard import require_own_packages
from protocol.links import link_of
from protocol.mission import Mission
from protocol.mission_file import load_mission
from protocol.process import BAD_INPUT, FAILED, TERMINATED
from protocol.session import Link
from sim_bridge.px4_endpoint.capture import show
from sim_bridge.px4_endpoint.endpoint import Endpoint

WRITE_PERIOD_S = 5.0
"""Between two versions of the truth files, so that a killed process leaves one."""
LINGER_S = 2.0
"""Real vehicles do not end with a run: agents that are ended at the same time can still tell theirs to land."""

log = logging.getLogger(__name__)


def parse(arguments: list[str] | None = None) -> tuple[Path, Path, str]:
    """Mission file, run folder, and the router's endpoint or nothing."""
    parser = argparse.ArgumentParser(prog="python -m sim_bridge.px4_endpoint")
    parser.add_argument("--mission", type=Path, required=True, help="mission file, TOML or JSON")
    parser.add_argument("--run", type=Path, required=True, help="folder for vehicles.npz and vehicles.json")
    parser.add_argument("--endpoint", default="", help="of the router, for the poses of motion capture")
    parser.add_argument("--speed", choices=("max", "1"), help="likewise; these vehicles know real time only")
    parsed = parser.parse_args(arguments)
    return parsed.mission, parsed.run, parsed.endpoint


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


def see(mission: Mission, link: Link, endpoint: Endpoint, ended: threading.Event) -> None:
    """Tell the mission where motion capture would see the vehicles, until ``ended``."""
    try:
        asyncio.run(show(mission, link, endpoint, ended))
    except CovreconError as error:
        log.error("no poses from motion capture: %s", error)  # noqa: TRY400  # says it all


def main() -> int:
    faulthandler.enable()
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    ended = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda _number, _frame: ended.set())
    try:
        require_own_packages()
        file, run, router = parse()
        mission = load_mission(file)
        endpoint = Endpoint(mission)
        if mission.localization.source == "mocap":
            link = link_of(mission, SIM, endpoint=router)
            seeing = threading.Thread(target=see, args=(mission, link, endpoint, ended), name="capture", daemon=True)
            seeing.start()
        return fly(endpoint, run, ended)
    except MissionError as error:
        log.error("%s", error)  # noqa: TRY400  # the fault is in the file, not here
        return BAD_INPUT


if __name__ == "__main__":
    sys.exit(main())
