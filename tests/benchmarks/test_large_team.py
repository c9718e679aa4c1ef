"""Teams of up to 32 drones on this machine, hearing each other directly and through the router's gathered states.

Router, ground station, simulator and one agent are the real processes; the other drones only talk (`faults.talkers`),
with the real bus, because two cores do not integrate and steer for 32. An observer, one more client of the router,
notes when states arrive; their ages count from their tick's nominal instant.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import zenoh

from deploy.local import environment, mission_roles
from faults.ports import free_port
from protocol import topics
from protocol.guard import ROOT
from protocol.messages import DroneState, TeamStates, Tick
from protocol.mission import Mission
from protocol.mission_file import load_mission, mission_to_json
from protocol.session import Link, configuration
from protocol.traffic import HEADER_BYTES, Carrier, Direction, Plan, traffic_of
from protocol.wire import Message, decode

Record = Callable[..., None]
TEAMS = (8, 16, 32)
A_PROCESS = 8
"""Talkers in one process."""
SETTLE_S, COUNTED_S = 6.0, 30.0
START_LIMIT_S, END_LIMIT_S = 90.0, 20.0
MISSION = """
name = "team"
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
endpoint = "{endpoint}"
aggregate_above = {above}
"""


@dataclass(slots=True)
class Figures:
    """Of one flight, by name."""

    values: dict[str, float] = field(default_factory=dict)
    planned: dict[str, float] = field(default_factory=dict)
    """By direction, kB/s a drone; measured ones are in ``values``."""


class Observer:
    """Hears ticks and states, direct and gathered, and when each came first."""

    def __init__(self, session: zenoh.Session) -> None:
        self._heard: list[tuple[type[Message], float, bytes]] = []
        self._kept = [
            session.declare_subscriber(topic.of("*"), self._hearer(topic.message))
            for topic in (topics.TICK, topics.STATE, topics.TEAM)
        ]

    def _hearer(self, kind: type[Message]) -> Callable[[zenoh.Sample], None]:
        return lambda sample: self._heard.append((kind, time.monotonic(), sample.payload.to_bytes()))

    def forget(self) -> None:
        self._heard.clear()

    @property
    def hears_ticks(self) -> bool:
        return any(kind is Tick for kind, _, _ in self._heard)

    def ages_s(self, tick_s: float) -> tuple[list[float], list[float]]:
        """Of direct states, as the ground station hears them, and of what is new in gathered ones."""
        heard = list(self._heard)
        ticks = [(decode(Tick, payload).tick, at) for kind, at, payload in heard if kind is Tick]
        epoch_s = min(at - tick * tick_s for tick, at in ticks)
        direct, gathered = [], {}
        for kind, at, payload in heard:
            if kind is DroneState:
                direct.append(at - epoch_s - tick_s * decode(DroneState, payload).tick)
            elif kind is TeamStates:
                message = decode(TeamStates, payload)
                told = [*zip(message.drones.tolist(), message.ticks.tolist(), strict=True)]
                earlier = message.drones[message.earlier_rows].tolist()
                for drone, tick in [*told, *zip(earlier, message.earlier_ticks.tolist(), strict=True)]:
                    gathered.setdefault((drone, tick), at - epoch_s - tick_s * tick)
        return direct, list(gathered.values())


@contextmanager
def observed(mission: Mission) -> Iterator[Observer]:
    """As soon as there is a router."""
    told = configuration("client", Link(mission.transport.endpoint), mission.name)
    deadline = time.monotonic() + START_LIMIT_S
    while True:
        try:
            session = zenoh.open(zenoh.Config.from_json5(json.dumps(told)))
            break
        except zenoh.ZError:
            assert time.monotonic() < deadline
            time.sleep(0.2)
    with session:
        yield Observer(session)


@contextmanager
def flying(mission: Mission, folder: Path) -> Iterator[dict[str, subprocess.Popen[bytes]]]:
    """Processes by name, ended at the end: the talkers so that they leave their reports."""
    file = folder / "mission.json"
    file.write_text(mission_to_json(mission))
    endpoint, ids = mission.transport.endpoint, [drone.id for drone in mission.drones]
    commands = {role.name: list(role.command) for role in mission_roles(folder, endpoint, ids[:1], "1")}
    for first in range(1, len(ids), A_PROCESS):
        some = ids[first : first + A_PROCESS]
        report = folder / f"talkers-{first}.json"
        command = [sys.executable, "-m", "faults.talkers", "--mission", str(file), "--endpoint", endpoint]
        commands[f"talkers-{first}"] = [*command, "--report", str(report), "--drones", *map(str, some)]
    paths = {"PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}"}
    running: dict[str, subprocess.Popen[bytes]] = {}
    try:
        for name, command in commands.items():
            with (folder / f"{name}.log").open("wb") as log:
                options = {"stdout": log, "stderr": subprocess.STDOUT, "env": environment(os.environ) | paths}
                running[name] = subprocess.Popen(command, **options)
        yield running
    finally:
        for name in reversed(running):
            running[name].send_signal(signal.SIGTERM)
        for process in reversed(running.values()):
            try:
                process.wait(END_LIMIT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


@dataclass(frozen=True, slots=True)
class Reading:
    """What processes had used up at one moment."""

    at_s: float
    cpu_s: dict[str, float]
    """By process."""
    streams: tuple[int, int] | None
    """Bytes that talkers sent and received; None where nobody counts."""


def read(running: Mapping[str, subprocess.Popen[bytes]]) -> Reading:
    talking = [process.pid for name, process in running.items() if name.startswith("talkers")]
    streams = stream_bytes(talking) if shutil.which("ss") is not None else None
    return Reading(time.monotonic(), {name: cpu_s(process) for name, process in running.items()}, streams)


def cpu_s(process: subprocess.Popen[bytes]) -> float:
    numbers = Path("/proc", str(process.pid), "stat").read_text().rpartition(")")[2].split()
    return (int(numbers[11]) + int(numbers[12])) / os.sysconf("SC_CLK_TCK")


def stream_bytes(pids: Sequence[int]) -> tuple[int, int]:
    """Of the TCP streams of these processes, sent and received. Not of IP packets: the loopback device takes so large
    ones that they tell nothing of a radio link's (tests/scenario/test_traffic.py counts those)."""
    command = ["ss", "-tinHOp", "state", "established"]
    told = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    sent = received = 0
    for line in told.splitlines():
        if any(f"pid={pid}," in line for pid in pids):
            counts = {name: int(value) for name, value in re.findall(r"(bytes_\w+):(\d+)", line)}
            sent += counts.get("bytes_sent", 0)
            received += counts.get("bytes_received", 0)
    return sent, received


def planned_rate(mission: Mission, direction: Direction) -> float:
    """kB/s of the TCP stream of a drone, mean of those that only talk."""
    rates = [
        flow.rate_hz * (flow.packet_bytes - HEADER_BYTES * flow.segments)
        for drone in mission.drones[1:]
        for flow in traffic_of(mission, drone.id, Plan(carrier=Carrier(tls=False))).flows
        if flow.direction == direction
    ]
    return sum(rates) / (len(mission.drones) - 1) / 1e3


def fly(count: int, *, gathered: bool, folder: Path) -> Figures:
    folder.mkdir()
    text = MISSION.format(endpoint=f"tcp/127.0.0.1:{free_port()}", above=0 if gathered else count)
    (folder / "team.toml").write_text(text)
    mission = load_mission(folder / "team.toml", drones=count)
    with flying(mission, folder) as running, observed(mission) as observer:
        deadline = time.monotonic() + START_LIMIT_S
        while not observer.hears_ticks:
            assert time.monotonic() < deadline
            assert all(process.poll() is None for process in running.values())
            time.sleep(0.1)
        time.sleep(SETTLE_S)
        observer.forget()
        before = read(running)
        time.sleep(COUNTED_S)
        after = read(running)
        direct_s, gathered_s = observer.ages_s(mission.tick_s)
    arrived_s = gathered_s if gathered else direct_s
    reports = [json.loads(path.read_text()) for path in folder.glob("talkers-*.json")]
    figures = used_up(mission, before, after)
    for share in (50, 99):
        figures.values[f"age_at_ground_p{share}"] = 1e3 * float(np.percentile(direct_s, share))
        figures.values[f"age_at_drone_p{share}"] = 1e3 * float(np.percentile(arrived_s, share))
        figures.values[f"age_used_p{share}"] = 1e3 * max(report["used_age_s"][str(share)] for report in reports)
    figures.values["arrived"] = len(arrived_s) * mission.tick_s / (count * (after.at_s - before.at_s))
    figures.values["fallbacks"] = sum(event.startswith("warning") for report in reports for event in report["events"])
    return figures


def used_up(mission: Mission, before: Reading, after: Reading) -> Figures:
    took_s, talkers = after.at_s - before.at_s, len(mission.drones) - 1
    cores = {name: (used - before.cpu_s[name]) / took_s for name, used in after.cpu_s.items()}
    figures = Figures(
        {
            "cpu_router": cores["router"],
            "cpu_ground": cores["ground"],
            "cpu_agent": cores["drone-1"],
            "cpu_talker": sum(share for name, share in cores.items() if name.startswith("talkers")) / talkers,
        }
    )
    if before.streams is not None and after.streams is not None:
        directions: tuple[Direction, ...] = ("up", "down")
        for direction, then, now in zip(directions, before.streams, after.streams, strict=True):
            figures.values[f"{direction}_rate"] = (now - then) / took_s / talkers / 1e3
            figures.planned[direction] = planned_rate(mission, direction)
    return figures


UNITS = {
    "cpu": "cores",
    "age": "ms",
    "arrived": "of all states",
    "fallbacks": "drones",
    "up": "kB/s a drone",
    "down": "kB/s a drone",
}


@pytest.mark.timeout(2 * len(TEAMS) * (START_LIMIT_S + COUNTED_S + END_LIMIT_S))
def test_large_teams(record: Record, tmp_path: Path) -> None:
    for count in TEAMS:
        direct = fly(count, gathered=False, folder=tmp_path / f"{count}-direct")
        gathered = fly(count, gathered=True, folder=tmp_path / f"{count}-gathered")
        for name, flight in (("direct", direct), ("gathered", gathered)):
            for direction, planned in flight.planned.items():
                measured = flight.values[f"{direction}_rate"]
                record(f"team_{count}_{direction}_{name}", measured, "kB/s a drone", "as planned", planned / measured)
        for figure, value in gathered.values.items():
            before = direct.values[figure]
            unit = UNITS[figure.partition("_")[0]]
            record(f"team_{count}_{figure}", value, unit, f"{before:.3g} heard directly", before / max(value, 1e-9))
