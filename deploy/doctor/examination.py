"""All checks, in the order in which a person would mend what they find."""

from __future__ import annotations

import platform
from collections.abc import Iterator
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError
from pathlib import Path

from deploy.doctor.certificates import check_certificates
from deploy.doctor.clock import ClockState, check_clock, read_clock
from deploy.doctor.finding import Finding
from deploy.doctor.gpu import check_gpu
from deploy.doctor.inputs import check_inputs
from deploy.doctor.libraries import INSTALL, check_libraries, required_libraries
from deploy.doctor.machine import check_machine
from deploy.doctor.network import check_network
from deploy.doctor.ports import check_place, check_socket_folder, places
from protocol.errors import MissionError
from protocol.mission import Mission


def examine(mission: Mission, out: Path, drone: int = 0) -> Iterator[Finding]:
    """Findings as they come; what takes long, loading the libraries, is last.

    Args:
        mission: what is to be flown here.
        out: where run folders are made.
        drone: the one of the mission whose computer this is; 0: everything but drones of a fleet runs here.

    Raises:
        MissionError: there is no such drone.
    """
    if drone:
        mission = _part_of(mission, drone)
    yield Finding("python", "ok", f"{platform.python_version()} on {platform.platform(terse=True)}")
    yield from check_network(mission)
    yield from check_certificates(mission.transport, datetime.now(UTC))
    yield from check_inputs(mission)
    yield check_socket_folder()
    for place in places(mission):
        if not drone or place.who.endswith(f"drone {drone}"):
            yield check_place(place)
    yield check_clock(_clock())
    yield from check_machine(mission, out)
    yield check_gpu()
    try:
        libraries = required_libraries()
    except PackageNotFoundError:
        yield Finding("libraries", "fail", "this program is not installed, so what it needs is not known", INSTALL)
        return
    yield from check_libraries(libraries, _needed_sets(mission, drone))


def _clock() -> ClockState | OSError:
    try:
        return read_clock()
    except OSError as error:
        return error


def _part_of(mission: Mission, drone: int) -> Mission:
    """What one drone's own computer needs of it."""
    known = {found.id: found for found in mission.drones}
    if drone not in known:
        raise MissionError([f"drones: there is no drone {drone}; the mission has {', '.join(map(str, known))}"])
    own = known[drone]
    if mission.vehicles.kind == "px4":
        own = own.model_copy(update={"url": mission.vehicle_url(own)})  # which counts the drones before it
    scene = mission.simulation.model_copy(update={"scene": ""})
    return mission.model_copy(update={"drones": (own,), "simulation": scene})


def _needed_sets(mission: Mission, drone: int) -> dict[str, str]:
    needed = {} if drone else {"ground": "the ground station, the simulator and reports need it"}
    if not drone and mission.reconstruction.backend == "learned":
        needed["learned"] = 'the mission says reconstruction.backend = "learned"'
    if any(drone.camera for drone in mission.drones):
        needed["camera"] = "the mission has real cameras"
    return needed
