"""One mission over MAVLink as real processes, at PX4-like vehicles in this one, where faults can be put into them."""

from __future__ import annotations

import itertools
import re
import socket
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from faults.processes import Flight, HarnessError, fly, write_scene
from protocol import topics
from protocol.bus import Bus, connect
from protocol.geometry import Floats
from protocol.messages import MissionPhase
from protocol.mission import Mission
from protocol.mission_file import load_mission
from sim_bridge.px4_endpoint.endpoint import Endpoint
from sim_bridge.px4_endpoint.guidance import Target
from sim_bridge.px4_endpoint.vehicle import Vehicle

PATIENCE_S = 40.0
"""For whatever a flight waits for, on a busy machine; most comes within a few seconds."""
HOME_M = 0.6
"""A drone that came home stands no further from its start: estimates are off, and the last metre is PX4's."""
PLACES = ((-1.2, -1.2, 0.8), (1.2, 1.2, -2.3), (-1.2, 1.2, -0.8), (1.2, -1.2, 2.3))
"""Where drones start, looking inwards: x, y, yaw. Each sees the target from there: one that sees nothing goes
nowhere."""

MISSION = """
name = "failures"
duration_s = 300.0
stop_below = 0.0001
[vehicles]
kind = "px4"
url = "udpin://127.0.0.1:{port}"
origin = [47.397742, 8.545594, 488.0]
takeoff_s = {takeoff_s}
gimbal_error_rad = 0.1
parameters = [{{ name = "MPC_TKO_RAMP_T", value = 0.3 }}, {{ name = "COM_DISARM_LAND", value = 0.5 }}]
[autopilot]
wind_mps = [0.3, 0.2]
gust_mps = 0.1
spool_up_s = 0.3
[target]
lower_m = [-1.5, -1.5, 0.0]
upper_m = [1.5, 1.5, 0.5]
[flight]
lower_m = [-3.0, -3.0, 0.5]
upper_m = [3.0, 3.0, 2.5]
position_error_m = 0.08
[controller]
coverage_rate_per_s = 0.1
[camera]
width_px = 80
height_px = 45
[reconstruction]
sweep_width_px = 40
depth_planes = 16
[recording]
report = false
[simulation]
scene = "{scene}"
[replication]
ground_patience_s = {ground_patience_s}
ground_lost = "{ground_lost}"
"""
"""Long enough for whatever happens: a flight's end is called by its test."""


def free_ports(count: int) -> int:
    """The first of ``count`` UDP ports in a row that nobody uses."""
    while True:
        sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
        try:
            sockets[0].bind(("127.0.0.1", 0))
            first: int = sockets[0].getsockname()[1]
            for index in range(1, count):
                sockets[index].bind(("127.0.0.1", first + index))
        except (OSError, OverflowError):
            continue
        else:
            return first
        finally:
            for each in sockets:
                each.close()


def px4_mission(
    folder: Path, drones: int, *, takeoff_s: float = 60.0, ground_patience_s: float = 60.0, ground_lost: str = "hold"
) -> Mission:
    """For drones 1, 3, 5, 7, on vehicles that are in a hurry."""
    text = MISSION.format(
        port=free_ports(drones),
        scene=write_scene(folder),
        takeoff_s=takeoff_s,
        ground_patience_s=ground_patience_s,
        ground_lost=ground_lost,
    )
    for index, (x, y, yaw) in enumerate(PLACES[:drones]):
        text += f"[[drones]]\nid = {2 * index + 1}\nstart = [{x}, {y}, 1.6, {yaw}, 1.3]\n"
    path = folder / "failures.toml"
    path.write_text(text)
    return load_mission(path)


@dataclass
class FlownDrone:
    """One drone: its vehicle, its agent's process and log, and the setpoints that reached the vehicle."""

    flight: Px4Flight
    id: int
    vehicle: Vehicle
    setpoints: list[tuple[float, float]] = field(default_factory=list)
    """Arrival by CLOCK_MONOTONIC, s, and commanded speed, m/s."""

    @property
    def name(self) -> str:
        """Of its process."""
        return f"drone-{self.id}"

    @property
    def log(self) -> str:
        return (self.flight.processes.run / "logs" / f"{self.name}.log").read_text(errors="replace")

    @property
    def mode(self) -> str:
        """As its newest state says."""
        state = self.flight.processes.monitor.states.get(self.id)
        return "silent" if state is None else state.mode

    @property
    def position(self) -> Floats:
        """(3,), true, world frame."""
        return np.array(self.vehicle.pose[:3])

    @property
    def speed(self) -> float:
        """True, m/s."""
        return float(np.linalg.norm(self.vehicle.aircraft.body.velocity))

    @property
    def home_m(self) -> float:
        """Horizontal distance from its start."""
        return float(np.linalg.norm(self.position[:2] - self.vehicle.drone.start[:2]))

    @property
    def is_down(self) -> bool:
        return self.vehicle.landed and not self.vehicle.armed

    @property
    def is_ours(self) -> bool:
        """Whether its vehicle flies what it is sent."""
        return self.vehicle.mode.name == "OFFBOARD" and self.vehicle.armed

    def hear(self, _drone: int, now_s: float, target: Target) -> None:
        self.setpoints.append((now_s, float(np.linalg.norm(target.velocity or (0.0, 0.0, 0.0)))))

    def said(self, order: str, *, after: int = 0) -> bool:
        """Whether ``order``, a regular expression, is in its log behind so many characters."""
        return re.search(order, self.log[after:]) is not None

    async def until(self, condition: Callable[[], bool], what: str, limit_s: float = PATIENCE_S) -> float:
        try:
            return await self.flight.until(condition, f"drone {self.id} {what}", limit_s)
        except HarnessError as error:
            raise HarnessError(f"{error}\n{self.account}") from None

    @property
    def account(self) -> str:
        """What is known of it, for who looks into a failure."""
        state = self.flight.processes.monitor.states.get(self.id)
        believed = state and f"{state.mode} at tick {state.tick}, pose {state.pose}, {state.control}"
        lines = [line[:200] for line in self.log.splitlines() if not re.search("parameter|preflight", line)][-12:]
        return "\n    ".join([f"{self.vehicle.mode.name} at {self.vehicle.pose}", f"says: {believed}", *lines])

    async def until_said(self, order: str, *, after: int = 0) -> None:
        await self.until(lambda: self.said(order, after=after), f"to say {order!r}")

    async def until_on_its_way(self) -> None:
        """Its agent flies it, and it is fast enough for a stop to be seen."""
        await self.until_said("fly: as planned")
        await self.until(lambda: self.is_ours and self.speed > 0.15, "to be on its way")

    async def until_it_moves_on(self) -> None:
        """It is in OFFBOARD, is sent velocities, and covers ground."""
        await self.until(lambda: self.is_ours, "to be in OFFBOARD")
        count, place = len(self.setpoints), self.position
        await self.until(lambda: any(speed > 0.02 for _, speed in self.setpoints[count:]), "to be sent somewhere")
        await self.until(lambda: float(np.linalg.norm(self.position - place)) > 0.1, "to move")

    async def until_down(self) -> None:
        await self.until(lambda: self.is_down, "to land and disarm")
        await self.until_said("land: landing")


@dataclass
class Px4Flight:
    processes: Flight
    autopilots: Endpoint
    bus: Bus
    drones: dict[int, FlownDrone] = field(default_factory=dict)

    async def until(self, condition: Callable[[], bool], what: str, limit_s: float = PATIENCE_S) -> float:
        """Wall time waited, s. Raises `HarnessError` when ``condition`` does not come true."""
        if not self.autopilots.running:
            raise HarnessError("the endpoint failed")
        return await self.processes.until(condition, what, limit_s)

    def call_off(self, reason: str) -> None:
        """End the mission, in the ground station's place."""
        self.bus.put(topics.PHASE, MissionPhase(phase="finished", reason=reason))

    def judge(self, outside_m: Mapping[int, float], astray_m: Mapping[int, float] | None = None) -> None:
        """Nobody came too near to another, and nobody left the flight region by more than the fence's margin, or what
        ``outside_m`` grants a drone for what was done to it. All of it is the truth, not what drones believe: where an
        estimate was put off by ``astray_m``, beyond the mission's ``position_error_m``, no row can keep the truth."""
        mission, off = self.processes.mission, astray_m or {}
        _, poses = self.autopilots.truth.poses()
        for (i, one), (j, other) in itertools.combinations(enumerate(self.drones), 2):
            nearest = float(np.linalg.norm(poses[:, i, :3] - poses[:, j, :3], axis=1).min())
            kept = mission.flight.separation_m - off.get(one, 0.0) - off.get(other, 0.0)
            assert nearest >= kept, f"drones {one} and {other}"
        low, high = np.array(mission.flight.lower_m), np.array(mission.flight.upper_m)
        low[2] = 0.0  # the ground, where they start and land
        for index, drone in enumerate(self.drones):
            flown = poses[:, index, :3]
            outside = float(np.maximum(low - flown, flown - high).max())
            assert outside <= outside_m.get(drone, mission.vehicles.fence_margin_m), f"drone {drone}"
            assert flown[:, 2].min() >= 0.0


@asynccontextmanager
async def px4_flight(
    mission: Mission, folder: Path, before: Callable[[Endpoint], None] = lambda _: None
) -> AsyncIterator[Px4Flight]:
    """A flight whose first tick has come. ``before``: what is done to the vehicles on the ground."""
    with Endpoint(mission) as autopilots:
        before(autopilots)
        async with fly(mission, folder) as processes, connect(processes.endpoint, mission.name) as bus:
            flight = Px4Flight(processes, autopilots, bus)
            for drone, vehicle in autopilots.vehicles.items():
                flight.drones[drone] = FlownDrone(flight, drone, vehicle)
                vehicle.on_setpoint = flight.drones[drone].hear
            yield flight
