"""A mission of real processes over hosts: the ground computer and every drone's, by mutual TLS, each with no more than
its own certificates."""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory

from deploy.local import process_group
from deploy.pki.files import make_folder
from deploy.run_folder import make_run_folder
from faults.certificates import make_credentials
from faults.hosts import Hosts
from faults.monitor import Monitor
from faults.processes import GRACE_S, PLACES, START_S, Box, Flight, commands_of, compile_once, write_scene
from protocol.bus import Bus, connect
from protocol.credentials import AUTHORITY_FILE, GROUND, REGISTER_FILE, ROUTER, SIM
from protocol.links import link_of
from protocol.mission import Mission
from protocol.mission_file import load_mission, mission_to_json

PORT = 7447
WATCHER = "operator-watcher"
"""Who watches the flight, from the ground computer."""

MISSION = """
name = "fleet"
duration_s = {duration_s}
[target]
lower_m = [-5.0, -5.0, 0.0]
upper_m = [5.0, 5.0, 0.6]
cell_m = 0.4
[flight]
lower_m = [-7.0, -7.0, 0.5]
upper_m = [7.0, 7.0, 2.5]
speed_max_mps = 0.3
[controller]
coverage_rate_per_s = 0.05
[feedback]
threshold = 1.0
gain = 0.2
[camera]
width_px = 160
height_px = 90
[reconstruction]
sweep_width_px = 80
depth_planes = 32
voxel_m = 0.05
truncation_m = 0.1
[recording]
report = false
[simulation]
scene = "{scene}"
[replication]
digest_period_s = 0.5
"""
"""As wide and as slow as it is because a drone that is silent may be anywhere that its top speed takes it: within a
small region the others would have to stop, and rightly, before there is anything to see."""
START_M, HEIGHT_M, PITCH_RAD = 1.0, 1.4, 1.3
"""Drones start so far from the middle along both axes, ..."""
OUTWARDS_RAD = (-2.36, 0.79, 2.36, -0.79)
"""... each in its quarter, and look outwards: to see well they back up, meet in the middle, and then spread."""
YARD: tuple[Box, ...] = (
    ((14.0, 14.0, 0.1), (0.0, 0.0, -0.05)),
    *(((0.8, 0.6, 0.35), (x, y, 0.175)) for x in (-3.6, 0.1, 3.5) for y in (-3.4, 0.2, 3.7)),
)
"""A floor with nine tables."""


def fleet_mission(folder: Path, duration_s: float) -> Mission:
    """For drones 1, 3, 5, 7."""
    text = MISSION.format(scene=write_scene(folder, YARD), duration_s=duration_s)
    for index, ((x, y, _), yaw) in enumerate(zip(PLACES, OUTWARDS_RAD, strict=True)):
        place = [START_M if value > 0 else -START_M for value in (x, y)]
        text += f"[[drones]]\nid = {2 * index + 1}\nstart = {[*place, HEIGHT_M, yaw, PITCH_RAD]}\n"
    path = folder / "fleet.toml"
    path.write_text(text)
    return load_mission(path)


def host_of(name: str) -> str:
    """Of a process: drones have one each, the others share the ground computer."""
    return name if name.startswith("drone-") else GROUND


@asynccontextmanager
async def fly_over(hosts: Hosts, mission: Mission, folder: Path) -> AsyncIterator[tuple[Flight, Bus]]:
    """A flight that has taken off, and the bus of who watches it; at the end none of its processes is left.

    The caller is on the ground computer already (`Hosts.enter`).
    """
    await asyncio.to_thread(compile_once, mission)
    endpoint = f"tls/{hosts.address(GROUND)}:{PORT}"
    missions = await asyncio.to_thread(_equip, folder / "hosts", mission, hosts.address(GROUND))
    run = make_run_folder(folder, load_mission(missions[GROUND]), datetime.now(UTC), endpoint)
    commands = {
        name: hosts.command(host_of(name), *_with_mission(missions[host_of(name)], command))
        for name, command in commands_of(mission, run, endpoint, {}).items()
    }
    with TemporaryDirectory(ignore_cleanup_errors=True) as private:
        async with process_group(Path(private), GRACE_S) as group:
            flight = Flight(mission, run, endpoint, {}, {}, commands, group)
            watched = load_mission(missions[WATCHER])
            try:
                flight.start("router")
                link = link_of(watched, WATCHER, endpoint=endpoint)
                async with connect(link, mission.name, timeout_s=START_S) as bus:
                    flight.monitor = Monitor(mission, bus)
                    for name in commands:
                        if name != "router":
                            flight.start(name)
                    await flight.until(lambda: flight.monitor.tick > 0, "the first tick", START_S)
                    yield flight, bus
            finally:
                flight.end()


def _with_mission(path: Path, command: Sequence[str]) -> list[str]:
    place = command.index("--mission") + 1
    return [*command[:place], str(path), *command[place + 1 :]]


def _equip(folder: Path, mission: Mission, address: str) -> dict[str, Path]:
    """A folder for every host, with what it is given before the flight: mission file and own certificates. Where each
    host's mission file lies; the watcher, who is a guest on the ground computer, has its own."""
    fleet = folder / "authority"
    make_credentials(
        fleet, tuple(drone.id for drone in mission.drones), (WATCHER.removeprefix("operator-"),), (address,)
    )
    owners = {GROUND: (ROUTER, GROUND, SIM), WATCHER: (WATCHER,)}
    owners |= {f"drone-{drone.id}": (f"drone-{drone.id}",) for drone in mission.drones}
    missions = {}
    for host, identities in owners.items():
        credentials = folder / host / "credentials"
        make_folder(credentials)
        names = [AUTHORITY_FILE, *(f"{identity}{end}" for identity in identities for end in (".pem", ".key"))]
        for name in [*names, *([REGISTER_FILE] if host == GROUND else [])]:
            shutil.copy2(fleet / name, credentials / name)
        transport = mission.transport.model_copy(update={"credentials": str(credentials)})
        missions[host] = folder / host / "mission.json"
        missions[host].write_text(mission_to_json(mission.model_copy(update={"transport": transport})))
    return missions
