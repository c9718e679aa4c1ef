"""Which vehicle a mission asks for."""

from __future__ import annotations

from collections.abc import Callable

from agents.vehicles.simulated import SimulatedVehicle
from agents.vehicles.vehicle import Vehicle
from protocol.bus import Bus
from protocol.mission import Mission


def make_vehicle(
    mission: Mission, drone: int, bus: Bus, *, now_s: Callable[[], float], events: Callable[[str, str], None]
) -> Vehicle:
    """``now_s``: the clock by which the agent judges silence; ``events`` takes a level and a text for people."""
    if mission.vehicles.kind == "simulated":
        start_m = mission.drone(drone).start[2]
        return SimulatedVehicle(bus, drone, mission.flight, mission.tick_s, now_s, start_m)
    from agents.vehicles.px4.vehicle import Px4Vehicle  # MAVSDK is not wanted in memory without an autopilot

    return Px4Vehicle(mission, drone, now_s=now_s, events=events)
