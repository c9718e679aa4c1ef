"""What drones on hosts of their own really send and receive, beside what `protocol.traffic` plans.

``python -m faults.traffic_flight --out FOLDER --states gathered`` flies four drones over radio links by mutual TLS, one
of which sends images, and counts the bytes of IP packets at their interfaces. It leaves ``figures.json``.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
from pathlib import Path

from faults.fleet_flight import fleet_mission, fly_over, host_of
from faults.hosts import Hosts, reason_against_hosts
from faults.judgement import Figures
from faults.processes import Flight
from faults.radio import WIRE, Shape
from protocol.credentials import GROUND
from protocol.guard import ROOT
from protocol.mission import Mission
from protocol.traffic import Plan, keyframe_rate_hz, traffic_of

RADIO = Shape(rate_bps=5e6, delay_s=0.03, queue_s=0.1)
DRONES = (1, 3, 5, 7)
SEEING = 3
"""The drone that sends images, ..."""
JPEG_BYTES = 20_800
"""... as large as the built-in room's."""
SPEED_MPS = 0.3
SETTLE_S, COUNTED_S, DURATION_S = 4.0, 15.0, 60.0
"""Mission time before the count, of the count, and of the mission, which is ended before."""


async def fly(hosts: Hosts, folder: Path, *, gathered: bool) -> Figures:
    """kB/s up and down of each drone, counted and planned."""
    mission = fleet_mission(folder, DURATION_S)
    above = 0 if gathered else len(DRONES)
    mission = mission.model_copy(update={"transport": mission.transport.model_copy(update={"aggregate_above": above})})
    clock = asyncio.get_running_loop().time
    async with fly_over(hosts, mission, folder) as (flight, _):
        _send_images(hosts, flight, mission, folder)
        await flight.flying(SETTLE_S)
        before, began_s = _counted(hosts, flight), clock()
        await flight.flying(COUNTED_S)
        after, took_s = _counted(hosts, flight), clock() - began_s
    figures: Figures = {"seconds": round(took_s, 2)}
    for drone in DRONES:
        name = f"drone-{drone}"
        plan = Plan(jpeg_bytes=JPEG_BYTES if drone == SEEING else None, speed_mps=SPEED_MPS)
        load = traffic_of(mission, drone, plan)
        counted = [(now - then) / took_s for then, now in zip(before[name], after[name], strict=True)]
        planned = [load.bytes_per_s("up"), load.bytes_per_s("down")]
        figures[name] = {
            direction: {"counted_kB_per_s": round(one / 1e3, 2), "planned_kB_per_s": round(other / 1e3, 2)}
            for direction, one, other in zip(("up", "down"), counted, planned, strict=True)
        }
    return figures


def _send_images(hosts: Hosts, flight: Flight, mission: Mission, folder: Path) -> None:
    """From the computer of one drone, with its own certificate."""
    name = f"drone-{SEEING}"
    rate_hz = keyframe_rate_hz(mission, SPEED_MPS)
    command = [
        sys.executable,
        "-m",
        "faults.picture_sender",
        "--mission",
        str(folder / "hosts" / name / "mission.json"),
    ]
    command += ["--endpoint", flight.endpoint, "--drone", str(SEEING)]
    command += ["--rate-hz", str(rate_hz), "--jpeg-bytes", str(JPEG_BYTES)]
    paths = f"{ROOT}:{ROOT / 'tests'}"
    hosts.start(name, "env", f"PYTHONPATH={paths}", *command, log=flight.run / "logs" / "pictures.log")


def _counted(hosts: Hosts, flight: Flight) -> dict[str, tuple[int, int]]:
    return {name: (hosts.bytes_up(name), hosts.bytes_down(name)) for name in flight.drones}


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m faults.traffic_flight", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder for figures and run")
    parser.add_argument("--states", choices=("gathered", "direct"), default="direct", help="how drones hear each other")
    told = parser.parse_args()
    out: Path = told.out.resolve()
    reason = reason_against_hosts()
    if reason is not None:
        print(f"cannot fly: {reason}")
        return 2
    out.mkdir(parents=True, exist_ok=True)
    with Hosts({GROUND: WIRE} | {host_of(f"drone-{drone}"): RADIO for drone in DRONES}) as hosts:
        hosts.enter(GROUND)
        figures = asyncio.run(fly(hosts, out, gathered=told.states == "gathered"))
    (out / "figures.json").write_text(json.dumps(figures, indent=2) + "\n")
    for name, figure in figures.items():
        print(f"{name}: {json.dumps(figure)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
