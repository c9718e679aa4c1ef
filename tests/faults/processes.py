"""One mission as real processes in real time, each of which can be stopped, killed, started again, or cut off."""

from __future__ import annotations

import asyncio
import functools
import os
import signal
import socket
import subprocess
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, TypeAlias

import numpy as np
import trimesh
from PIL import Image

from deploy.local import environment, mission_roles, process_group
from deploy.mission_run import compile_everything
from deploy.run_folder import make_run_folder
from faults.datagrams import DatagramLink, datagram_link
from faults.monitor import Monitor
from faults.ports import free_port
from faults.proxy import Link, link
from protocol.bus import connect
from protocol.guard import ROOT
from protocol.mission import Mission
from protocol.mission_file import load_mission

START_S = 90.0
"""For all processes of a flight to import, connect and take off on a busy machine."""
END_S = 30.0
"""For everybody to end after the ground station did."""
GRACE_S = 2.0
POLL_S = 0.02

MISSION = """
name = "small"
duration_s = {duration_s}
stop_below = {stop_below}
[target]
lower_m = [-1.0, -1.0, 0.0]
upper_m = [1.0, 1.0, 0.6]
[sensing]
decay_per_s = {decay}
[flight]
lower_m = [-2.0, -2.0, 0.5]
upper_m = [2.0, 2.0, 2.5]
[controller]
coverage_rate_per_s = {rate}
[feedback]
threshold = 1.0
gain = 0.5
[camera]
width_px = 160
height_px = 90
[reconstruction]
sweep_width_px = 80
depth_planes = 32
[recording]
report = false
[simulation]
scene = "{scene}"
start_patience_s = {patience}
[replication]
digest_period_s = 0.5
checkpoint_period_s = 2.0
"""
LOCKSTEP_MISSION = """
name = "small"
duration_s = 8.0
[target]
lower_m = [-1.0, -1.0, 0.0]
upper_m = [1.0, 1.0, 0.6]
[flight]
lower_m = [-2.0, -2.0, 0.5]
upper_m = [2.0, 2.0, 2.5]
[controller]
coverage_rate_per_s = 0.2
[feedback]
threshold = 1.0
period_s = 1.0
delay_s = 0.5
[camera]
width_px = 160
height_px = 90
[reconstruction]
sweep_width_px = 80
depth_planes = 32
[recording]
report = false
[simulation]
scene = "{scene}"
[[drones]]
id = 1
start = [-0.8, 0.0, 1.4, 0.0, 1.3]
[[drones]]
id = 3
start = [0.8, 0.0, 1.4, 3.0, 1.3]
"""
"""Two drones, eight seconds as fast as it goes; ``{scene}`` is a path."""
PACE = {1: (0.2, 3.0), 2: (0.1, 1.5), 4: (0.05, 0.8)}
"""By team size: wished coverage rate and decay, 1/s, with which a flight takes about 40 s."""
STOP_BELOW = 0.12
DURATION_S = 240.0
PLACES = ((-0.9, -0.9, 0.0), (0.9, 0.9, 3.0), (-0.9, 0.9, 0.0), (0.9, -0.9, 3.0))
"""Where drones start: x, y, yaw."""

Point: TypeAlias = tuple[float, float, float]
Box: TypeAlias = tuple[Point, Point]
"""Extents and centre, m."""
TABLE: tuple[Box, ...] = (((3.0, 3.0, 0.1), (0, 0, -0.05)), ((0.8, 0.6, 0.35), (0.1, 0.0, 0.175)))

Transport = Literal["tcp", "udp"]


class HarnessError(Exception):
    """A flight that did not do what it should within its bound."""


def processes_of(folder: Path, module: str = "") -> list[int]:
    """Processes that were started with a path in ``folder``, all or those of one module."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            command = (entry / "cmdline").read_bytes().decode(errors="replace")
        except OSError:
            continue  # it ended while we looked
        if str(folder) in command and (not module or f"\0-m\0{module}\0" in command):
            found.append(int(entry.name))
    return found


def write_scene(folder: Path, boxes: Sequence[Box] = TABLE) -> Path:
    """Boxes, every face covered with random patches; a table on a floor is as small as a world can be and still be
    mapped."""
    patches = np.random.default_rng(7).integers(0, 255, (20, 20, 3), dtype=np.uint8)
    image = Image.fromarray(patches).resize((512, 512), Image.Resampling.BICUBIC)
    parts = []
    for extents, centre in boxes:
        box = trimesh.creation.box(extents)
        box.apply_translation(centre)
        box.unmerge_vertices()
        along = np.abs(box.face_normals).argmax(axis=1).repeat(3)
        flat = np.array([np.delete(vertex, axis) for vertex, axis in zip(box.vertices, along, strict=True)])
        box.visual = trimesh.visual.TextureVisuals(uv=flat / 1.6, image=image)  # type: ignore[no-untyped-call]  # trimesh has no types
        parts.append(box)
    path = folder / "table.obj"
    trimesh.Scene(parts).to_mesh().export(path)
    return path


def small_mission(
    folder: Path,
    drones: int,
    *,
    stop_below: float = STOP_BELOW,
    duration_s: float = DURATION_S,
    patience_s: float = START_S,
) -> Mission:
    """Ids are 1, 3, 5, 7: they need not be 1 to n. ``patience_s``: how long the start waits for who is not there."""
    rate, decay = PACE[drones]
    text = MISSION.format(
        scene=write_scene(folder),
        duration_s=duration_s,
        stop_below=stop_below,
        rate=rate,
        decay=decay,
        patience=patience_s,
    )
    for index, (x, y, yaw) in enumerate(PLACES[:drones]):
        text += f"[[drones]]\nid = {2 * index + 1}\nstart = [{x}, {y}, 1.4, {yaw}, 1.3]\n"
    path = folder / "small.toml"
    path.write_text(text)
    return load_mission(path)


@functools.cache
def compile_once(mission: Mission) -> None:
    compile_everything(mission)


@dataclass
class Flight:
    """A mission's processes by name: router, sim, ground, drone-1 ..."""

    mission: Mission
    run: Path
    endpoint: str
    """The router's own."""
    links: dict[str, Link]
    datagram_links: dict[str, DatagramLink]
    monitor: Monitor = field(init=False)
    commands: dict[str, tuple[str, ...]]
    """What each is started by."""
    _group: int
    _running: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)

    @property
    def drones(self) -> list[str]:
        return [name for name in self.commands if name.startswith("drone-")]

    def start(self, name: str) -> None:
        if self.code(name) is None and name in self._running:
            raise HarnessError(f"{name} still runs")
        with (self.run / "logs" / f"{name}.log").open("ab") as log:
            self._running[name] = subprocess.Popen(
                self.commands[name],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=environment(os.environ) | {"PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}"},
                process_group=self._group,
            )

    @property
    def running(self) -> list[str]:
        return [name for name in self._running if self.code(name) is None]

    def pid(self, name: str) -> int:
        return self._running[name].pid

    def code(self, name: str) -> int | None:
        """How it ended; None while it runs, or before it was started."""
        process = self._running.get(name)
        return None if process is None else process.poll()

    def signal(self, name: str, number: signal.Signals) -> None:
        if self.code(name) is not None:
            raise HarnessError(f"{name} has ended already, with {self.code(name)}{self.log_end(name)}")
        self._running[name].send_signal(number)

    async def kill(self, name: str) -> None:
        self.signal(name, signal.SIGKILL)
        await self.until(lambda: self.code(name) is not None, f"{name} to die", END_S)

    async def until(self, condition: Callable[[], bool], what: str, limit_s: float) -> float:
        """Wall time waited, s. Raises `HarnessError` when ``condition`` does not come true."""
        clock = asyncio.get_running_loop().time
        began = clock()
        while not condition():
            if clock() - began > limit_s:
                raise HarnessError(f"waited {limit_s:g} s for {what}{self.casualties()}")
            await asyncio.sleep(POLL_S)
        return clock() - began

    async def flying(self, seconds: float) -> None:
        """Let so much mission time pass, seen by the monitor."""
        last = self.monitor.tick + round(seconds / self.mission.tick_s)
        await self.until(lambda: self.monitor.tick >= last, f"{seconds:g} s of flight", seconds * 3 + START_S)

    def end(self) -> None:
        """Kill whoever is left; the stopped too."""
        for process in self._running.values():
            if process.poll() is None:
                process.kill()
                process.wait()

    def casualties(self) -> str:
        """Who ended badly, with its last words."""
        ended = ((name, self.code(name)) for name in self._running)
        return "".join(f"\n{name} ended with {code}{self.log_end(name)}" for name, code in ended if code)

    def log_end(self, name: str) -> str:
        lines = (self.run / "logs" / f"{name}.log").read_text(errors="replace").splitlines()[-6:]
        return "".join(f"\n    {line}" for line in lines)


@asynccontextmanager
async def fly(
    mission: Mission,
    folder: Path,
    *,
    linked: Sequence[str] = (),
    transport: Transport = "tcp",
    late: Sequence[str] = (),
) -> AsyncIterator[Flight]:
    """A flight that has taken off; at the end none of its processes is left, whatever happened.

    ``linked``: who reaches the router by a link that can be made bad. ``late``: who is not started yet.
    """
    await asyncio.to_thread(compile_once, mission)
    port = free_port(socket.SOCK_STREAM if transport == "tcp" else socket.SOCK_DGRAM)
    endpoint = f"{transport}/127.0.0.1:{port}"
    run = make_run_folder(folder, mission, datetime.now(UTC), endpoint)
    async with AsyncExitStack() as stack:
        links: dict[str, Link] = {}
        datagram_links: dict[str, DatagramLink] = {}
        for index, name in enumerate(linked):
            if transport == "tcp":
                links[name] = await stack.enter_async_context(link(port, seed=index))
            else:
                datagram_links[name] = await stack.enter_async_context(datagram_link(port, seed=index))
        private = Path(stack.enter_context(TemporaryDirectory(ignore_cleanup_errors=True)))
        group = await stack.enter_async_context(process_group(private, GRACE_S))
        ways = {name: made.endpoint for name, made in (links | datagram_links).items()}
        commands = commands_of(mission, run, endpoint, ways)
        flight = Flight(mission, run, endpoint, links, datagram_links, commands, group)
        try:
            flight.start("router")
            bus = await stack.enter_async_context(connect(endpoint, mission.name, timeout_s=START_S))
            flight.monitor = Monitor(mission, bus)
            for name in commands:
                if name not in ("router", *late):
                    flight.start(name)
            await flight.until(lambda: flight.monitor.tick > 0, "the first tick", START_S)
            yield flight
        finally:
            flight.end()


def commands_of(mission: Mission, run: Path, endpoint: str, ways: dict[str, str]) -> dict[str, tuple[str, ...]]:
    """Of each process, with its own way to the router, and the simulator with a witness where it carries vehicles."""
    drones, px4 = [drone.id for drone in mission.drones], mission.vehicles.kind == "px4"
    simulator = "sim_bridge" if px4 else "faults.witness"
    commands = {}
    for name in [role.name for role in mission_roles(run, endpoint, drones, "1", px4=px4)]:
        (role,) = (r for r in mission_roles(run, ways.get(name, endpoint), drones, "1", px4=px4) if r.name == name)
        commands[name] = tuple(simulator if word == "sim_bridge" else word for word in role.command)
    return commands
