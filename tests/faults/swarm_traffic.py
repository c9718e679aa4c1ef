"""The traffic of a large team, counted and planned: drones that only talk, all on one computer, the rest on another.

``python -m faults.swarm_traffic --out FOLDER --drones 16 --states gathered`` counts the bytes of IP packets between the
two, by mutual TLS, and leaves ``figures.json`` with what a drone sends and receives on average.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

from deploy.local import environment, mission_roles
from faults.certificates import make_credentials
from faults.hosts import Hosts, reason_against_hosts
from faults.judgement import Figures
from faults.processes import END_S, START_S
from faults.radio import WIRE, Shape
from protocol.credentials import GROUND
from protocol.guard import ROOT
from protocol.mission import Mission
from protocol.mission_file import load_mission, mission_to_json
from protocol.traffic import radio_bytes_per_s, traffic_of

SWARM = "swarm"
LINK = Shape(rate_bps=1e9, delay_s=0.005, queue_s=1.0)
"""Wide enough for all, and far enough that acknowledgements take their time."""
A_PROCESS = 8
"""Talkers in one process."""
SETTLE_S, COUNTED_S = 5.0, 10.0
FLYING_BYTES = 5_000
"""Sent by a drone in a second: more than keep-alives are, and less than states."""
MISSION = """
name = "swarm"
duration_s = 600
[flight]
lower_m = [-9.0, -9.0, 0.5]
upper_m = [9.0, 9.0, 5.0]
[simulation]
scene = ""
[reconstruction]
backend = "none"
[feedback]
method = "none"
[recording]
report = false
[transport]
endpoint = "tls/{address}:7447"
credentials = "{credentials}"
aggregate_above = {above}
"""


def swarm_mission(folder: Path, address: str, drones: int, *, gathered: bool) -> Mission:
    credentials = folder / "credentials"
    make_credentials(credentials, tuple(range(1, drones + 1)), (), (address,))
    file = folder / "swarm.toml"
    file.write_text(MISSION.format(address=address, credentials=credentials, above=0 if gathered else drones))
    mission = load_mission(file, drones=drones)
    (folder / "mission.json").write_text(mission_to_json(mission))
    return mission


def start(hosts: Hosts, mission: Mission, folder: Path) -> list[subprocess.Popen[bytes]]:
    paths = {"PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}"}
    ids, endpoint = [drone.id for drone in mission.drones], mission.transport.endpoint
    commands = [(GROUND, role.name, role.command) for role in mission_roles(folder, endpoint, [], "1")]
    for first in range(0, len(ids), A_PROCESS):
        name, some = f"talkers-{first}", ids[first : first + A_PROCESS]
        report = folder / f"{name}.json"
        told = (sys.executable, "-m", "faults.talkers", "--mission", str(folder / "mission.json"))
        told += ("--endpoint", endpoint, "--report", str(report), "--drones", *map(str, some))
        commands.append((SWARM, name, told))
    return [
        hosts.start(host, *command, log=folder / f"{name}.log", env=environment(os.environ) | paths)
        for host, name, command in commands
    ]


def fly(hosts: Hosts, folder: Path, drones: int, *, gathered: bool) -> Figures:
    """kB/s up and down of a drone, counted and planned; of all drones the planned sum."""
    mission = swarm_mission(folder, hosts.address(GROUND), drones, gathered=gathered)
    running = start(hosts, mission, folder)
    deadline_s = time.monotonic() + START_S
    while not _is_flying(hosts, drones):
        assert time.monotonic() < deadline_s, "nobody flies"
        assert all(process.poll() is None for process in running), "somebody ended"
    time.sleep(SETTLE_S)
    before, began_s = (hosts.bytes_up(SWARM), hosts.bytes_down(SWARM)), time.monotonic()
    time.sleep(COUNTED_S)
    after, took_s = (hosts.bytes_up(SWARM), hosts.bytes_down(SWARM)), time.monotonic() - began_s
    for process in reversed(running):
        process.terminate()
    for process in running:
        process.wait(END_S)
    loads = [traffic_of(mission, drone.id) for drone in mission.drones]
    counted = [(now - then) / took_s / drones for then, now in zip(before, after, strict=True)]
    planned = [sum(load.bytes_per_s(way) for load in loads) / drones for way in ("up", "down")]
    figures: Figures = {
        direction: {"counted_kB_per_s": round(one / 1e3, 2), "planned_kB_per_s": round(other / 1e3, 2)}
        for direction, one, other in zip(("up", "down"), counted, planned, strict=True)
    }
    return figures | {"radio_planned_kB_per_s": round(radio_bytes_per_s(mission) / 1e3, 1)}


def _is_flying(hosts: Hosts, drones: int) -> bool:
    before = hosts.bytes_up(SWARM)
    time.sleep(1.0)
    return hosts.bytes_up(SWARM) - before > FLYING_BYTES * drones


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m faults.swarm_traffic", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder for figures and logs")
    parser.add_argument("--drones", type=int, default=16)
    parser.add_argument("--states", choices=("gathered", "direct"), default="gathered")
    told = parser.parse_args()
    out: Path = told.out.resolve()
    reason = reason_against_hosts()
    if reason is not None:
        print(f"cannot fly: {reason}")
        return 2
    out.mkdir(parents=True, exist_ok=True)
    with Hosts({GROUND: WIRE, SWARM: LINK}) as hosts:
        figures = fly(hosts, out, told.drones, gathered=told.states == "gathered")
    (out / "figures.json").write_text(json.dumps(figures, indent=2) + "\n")
    print(json.dumps(figures))
    return 0


if __name__ == "__main__":
    sys.exit(main())
