"""What all processes of a mission have in common: arguments, logging, signals and exit codes."""

from __future__ import annotations

import argparse
import asyncio
import faulthandler
import logging
import signal
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from pathlib import Path

import uvloop

from protocol.credentials import GROUND, MAPPER, MOCAP, OPERATOR, ROUTER, SIM, identity_of_drone
from protocol.errors import BusError, CovreconError, CredentialsError, MissionError, SceneError, VehicleError
from protocol.guard import require_own_packages
from protocol.links import link_of
from protocol.logs import configure, say_last
from protocol.mission import Mission
from protocol.mission_file import load_mission
from protocol.service import told
from protocol.session import Link

DONE, FAILED, BAD_INPUT, TERMINATED = 0, 1, 2, 143
"""Exit codes; BAD_INPUT means that the mission, the scene, the endpoint or a certificate is to be mended."""

IDENTITIES = {
    "protocol.router": ROUTER,
    "ground_station": GROUND,
    "sim_bridge": SIM,
    "ground_station.console": OPERATOR,
    "ground_station.motion_capture": MOCAP,
    "mapper": MAPPER,
}
"""Who each kind of process is, by its module; a mapper's is the user's own, and an agent is its drone."""

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Arguments:
    mission: Mission
    link: Link
    """How it reaches the others."""
    run: Path
    """The run's folder: what this process leaves behind goes there."""
    lockstep: bool
    drone: int
    """0 where it has no meaning."""


def parse(role: str, arguments: list[str] | None = None) -> Arguments:
    """Command line of ``python -m agents`` and the like.

    Raises:
        MissionError: the mission cannot be flown.
        CredentialsError: it needs a certificate and has none that is good.
        BusError: nobody says where the router is.
    """
    parser = argparse.ArgumentParser(prog=f"python -m {role}")
    parser.add_argument("--mission", type=Path, required=True, help="mission file, TOML or JSON")
    parser.add_argument("--endpoint", default="", help="zenoh endpoint of the router, instead of the mission's")
    parser.add_argument("--run", type=Path, required=True, help="folder for results and logs")
    parser.add_argument("--speed", choices=("max", "1"), default="1", help="max: lockstep; 1: real time")
    if role == "agents":
        parser.add_argument("--drone", type=int, required=True, help="id of the drone to fly")
    parsed = parser.parse_args(arguments)
    mission = load_mission(parsed.mission)
    drone = getattr(parsed, "drone", 0)
    if role == "agents" and drone not in {known.id for known in mission.drones}:
        raise MissionError([f"{parsed.mission}: drones: there is no drone {drone}"])
    lockstep = parsed.speed == "max" and mission.vehicles.kind == "simulated"  # nothing makes a PX4 wait
    identity = IDENTITIES.get(role) or identity_of_drone(drone)
    link = link_of(mission, identity, endpoint=parsed.endpoint)
    return Arguments(mission, link, parsed.run, lockstep, drone)


def run_process(role: str, body: Callable[[Arguments], Coroutine[None, None, None]]) -> int:
    """Run one process's ``body`` to its end or to SIGTERM; its exit code. Stderr's last line says what failed."""
    faulthandler.enable()
    try:
        configure(role)
        require_own_packages()
        arguments = parse(role)
        configure(role, arguments.mission.name, arguments.drone)
        # An eighth less CPU a tick than asyncio's own loop, in lockstep where a tick is nothing but messages.
        return uvloop.run(_until_signal(body(arguments)))
    except (MissionError, SceneError, BusError, CredentialsError) as error:
        say_last(error)
        return BAD_INPUT
    except VehicleError as error:  # the vehicle's fault: where it was noticed in the program helps nobody
        say_last(error)
        return FAILED
    except CovreconError as error:
        log.exception("failed")
        say_last(error)
        return FAILED


async def _until_signal(body: Coroutine[None, None, None]) -> int:
    async with told():
        task = asyncio.ensure_future(body)
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, task.cancel)
        try:
            await task
        except asyncio.CancelledError:
            log.info("ended by a signal")
            return TERMINATED
        return DONE
