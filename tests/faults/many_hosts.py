"""A fleet on many hosts: the ground computer and four drones, each in a network namespace behind a radio link.

``python -m faults.many_hosts --out FOLDER`` flies it as root: one drone's link is cut for a while, then another drone's
computer is lost for good. It leaves ``figures.json``, a picture and the run's folder, and says whether all held.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from faults.fleet_flight import fleet_mission, fly_over, host_of
from faults.fleet_log import FleetLog
from faults.hosts import Hosts, reason_against_hosts
from faults.judgement import Figures, compare_replicas, judge_journal, judge_separation
from faults.many_hosts_figure import draw
from faults.processes import END_S, Flight, HarnessError
from faults.radio import WIRE, Shape
from faults.witness import true_positions
from protocol.credentials import GROUND

RADIO = Shape(rate_bps=5e6, delay_s=0.03, queue_s=0.1)
DRONES = (1, 3, 5, 7)
CUT, LOST = 3, 5
"""The drone whose link is cut for a while, and the one whose computer is lost."""
WELL_S, CUT_S, AFTER_S = 12.0, 8.0, 8.0
"""Mission time before anything happens, of the cut, and watched after the loss is told."""
DURATION_S = 48.0
"""Of the mission: what is waited for in between comes within seconds."""
HEAL_S = 15.0
"""For the drone that was cut off to be heard again, to know all of phi, and for all to fly on."""
NOTICE_S = 8.0
"""For the loss to be told: a lease, as much for TCP, and two status messages."""
WAY_M = 1.0
"""What each drone that is left flies at least after the loss: at full speed it would be 3.4 m."""
FALL = 0.02
"""Of J, at least, in every part of the flight, ..."""
J_END = 0.8
"""... and where it ends at the latest. In five flights, by whichever ways, it ended between 0.65 and 0.69."""


async def scenario(hosts: Hosts, flight: Flight, log: FleetLog, figures: Figures) -> list[str]:
    """All well; a link cut and healed; a computer lost. Violations; ``figures`` gets what was measured."""
    others = [drone for drone in DRONES if drone != LOST]
    async with log.phase("all well"):
        await flight.flying(WELL_S)
    async with log.phase("link cut"):
        hosts.cut(f"drone-{CUT}")
        await flight.flying(CUT_S)
        hosts.heal(f"drone-{CUT}")
    async with log.phase("healed"):
        figures["healed_in_s"] = round(await flight.until(flight.monitor.is_healed, "the drone to be back", HEAL_S), 2)
        took_s = await flight.until(lambda: all(map(log.flies, DRONES)), "all to fly on", HEAL_S)
        figures["all_fly_in_s"] = round(took_s, 2)
        violations = await compare_replicas(flight, figures)
    async with log.phase("computer lost"):
        hosts.cut(f"drone-{LOST}")
        flight.signal(f"drone-{LOST}", signal.SIGKILL)
        took_s = await flight.until(lambda: not _is_told_alive(flight, LOST), "the loss to be told", NOTICE_S)
        figures["loss_told_in_s"] = round(took_s, 2)
        await flight.flying(AFTER_S)
        without: Figures = {}
        violations += await compare_replicas(flight, without, lost=[LOST])
        figures["replicas_without_the_lost"] = without
        if not flight.monitor.is_healed(lost=[LOST]):
            violations.append(f"of {others}, not all are there and up to date: {flight.monitor.replicas()}")
    return violations


def _is_told_alive(flight: Flight, drone: int) -> bool:
    status = flight.monitor.status
    return status is None or next(row.alive for row in status.drones if row.drone == drone)


def judge_going_on(flight: Flight, log: FleetLog, figures: Figures) -> list[str]:
    """J falls all the time, and those who are left fly on after the loss."""
    violations = []
    before = log.heard[0].importance
    for phase in log.phases:
        if phase.name != "healed":
            after = log.importance_at(phase.end.tick)
            if after > before - FALL:
                violations.append(f"{phase.name}: J went from {before:.3f} to {after:.3f}")
            before = after
    if log.heard[-1].importance > J_END:
        violations.append(f"J is still {log.heard[-1].importance:.3f}")
    lost = log.phases[-1]
    places = np.array([at for tick, at in true_positions(flight.run) if lost.begin.tick <= tick <= lost.end.tick])
    ways_m = np.linalg.norm(np.diff(places, axis=0), axis=2).sum(axis=0).round(2)
    figures["flown_after_the_loss_m"] = {
        f"drone-{drone}": float(way) for drone, way in zip(DRONES, ways_m, strict=True)
    }
    stood = [name for name, way in figures["flown_after_the_loss_m"].items() if way < WAY_M and name != f"drone-{LOST}"]
    return violations + [f"{name} did not fly on" for name in stood]


async def _end(flight: Flight) -> list[str]:
    """The mission ends by itself, and with it all who are left."""
    await flight.until(lambda: flight.code("ground") is not None, "the mission to end", DURATION_S)
    left = [name for name in ("sim", *flight.drones) if name != f"drone-{LOST}"]
    await flight.until(lambda: all(flight.code(name) is not None for name in left), "all to end", END_S)
    return [f"{name} ended with {flight.code(name)}" for name in ("ground", *left) if flight.code(name)]


async def fly(hosts: Hosts, folder: Path) -> Figures:
    """Fly the scenario; what was measured, and under ``violations`` what did not hold."""
    mission = fleet_mission(folder, DURATION_S)
    figures: Figures = {}
    violations: list[str] = []
    try:
        async with fly_over(hosts, mission, folder) as (flight, bus):
            log = FleetLog(flight, hosts, bus)
            violations += await scenario(hosts, flight, log, figures)
            violations += await _end(flight)
            violations += judge_separation(flight, figures)
            violations += judge_journal(flight, figures, new_epoch=False)
            violations += flight.monitor.contradictions
            violations += judge_going_on(flight, log, figures)
            figures |= log.figures()
            draw(log, flight, folder / "many-hosts.png")
    except HarnessError as error:
        violations.append(str(error))
    figures["radio"] = hosts.figures()
    return figures | {"violations": violations}


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m faults.many_hosts", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder for figures, picture and run")
    out: Path = parser.parse_args(arguments).out.resolve()
    reason = reason_against_hosts()
    if reason is not None:
        print(f"cannot fly: {reason}")
        return 2
    out.mkdir(parents=True, exist_ok=True)
    with Hosts({GROUND: WIRE} | {host_of(f"drone-{drone}"): RADIO for drone in DRONES}) as hosts:
        hosts.enter(GROUND)
        figures = asyncio.run(fly(hosts, out))
    (out / "figures.json").write_text(json.dumps(figures, indent=2) + "\n")
    for name, figure in figures.items():
        print(f"{name}: {json.dumps(figure)}")
    return 1 if figures["violations"] else 0


if __name__ == "__main__":
    sys.exit(main())
