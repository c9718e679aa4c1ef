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

from protocol.errors import BusError, CovreconError, MissionError, SceneError, VehicleError
from protocol.guard import require_own_packages
from protocol.logs import configure, say_last
from protocol.mission import Mission
from protocol.mission_file import load_mission

DONE, FAILED, BAD_INPUT, TERMINATED = 0, 1, 2, 143
"""Exit codes; BAD_INPUT means that the mission, the scene or the endpoint is to be mended."""

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Arguments:
    mission: Mission
    endpoint: str
    run: Path
    """The run's folder: what this process leaves behind goes there."""
    lockstep: bool
    drone: int
    """0 where it has no meaning."""


def parse(role: str, arguments: list[str] | None = None) -> Arguments:
    """Command line of ``python -m agents`` and the like.

    Raises:
        MissionError: the mission cannot be flown.
    """
    parser = argparse.ArgumentParser(prog=f"python -m {role}")
    parser.add_argument("--mission", type=Path, required=True, help="mission file, TOML or JSON")
    parser.add_argument("--endpoint", required=True, help="zenoh endpoint of the router")
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
    return Arguments(mission, parsed.endpoint, parsed.run, lockstep, drone)


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
    except (MissionError, SceneError, BusError) as error:
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
