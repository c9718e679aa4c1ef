"""What a mission takes, before take-off: the figures of a virtual flight without images.

Time to J, flight time, batteries and swaps come from the same agents, rows and battery model as in flight. Without
images the map's feedback does not raise J, which in flight takes longer.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from agents.energy import landing_s
from ground_station.report.run_data import Flight, Run
from ground_station.report.spells import spells
from protocol.battery_settings import JOULES_PER_WH
from protocol.errors import MissionError, ProcessError
from protocol.mission import Mission

GROUND_M = 0.06
"""Below this height a vehicle stands on the ground."""
HOME_M = 0.5
"""Who comes down farther from its start has not come home."""
REACHED = "importance fell below"
"""How a ground station's reason begins when the mission is done."""


@dataclass(frozen=True, slots=True)
class Swap:
    start_s: float
    """When the drone had landed ..."""
    end_s: float
    """... and when it left the ground again."""


@dataclass(frozen=True, slots=True)
class DronePlan:
    drone: int
    flight_s: float
    """Time off the ground."""
    batteries: int | None
    """None: they are endless."""
    least_share: float | None
    """In the air; None likewise."""
    swaps: tuple[Swap, ...]
    stranded: str
    """Where it came down that is not its start; empty if nowhere."""


@dataclass(frozen=True, slots=True)
class Plan:
    mission: str
    reached: bool
    """Whether J fell below what the mission asks for; True of a mission that asks for none."""
    reason: str
    """Why the mission ended, as the ground station says."""
    stop_below: float
    importance: float
    """J at the end."""
    duration_s: float
    nobody_s: float
    """For how long all stood on the ground at once."""
    min_separation_m: float | None
    drones: tuple[DronePlan, ...]

    @property
    def batteries(self) -> int | None:
        """All drones together."""
        counts = [drone.batteries for drone in self.drones]
        return None if None in counts else sum(count or 0 for count in counts)

    @property
    def faults(self) -> list[str]:
        """Why this mission should not be flown so; none: it should."""
        found = [
            f"drone {drone.drone}: its battery does not take it home: {drone.stranded}"
            for drone in self.drones
            if drone.stranded
        ]
        if not self.reached:
            found.append(
                f"J {self.importance:.3f} is as low as it gets, after {self.duration_s:.0f} s, not {self.stop_below:g}:"
                f" {self.reason}"
            )
        return found

    def as_json(self) -> dict[str, Any]:
        return {**asdict(self), "batteries": self.batteries, "faults": self.faults}


def virtual(mission: Mission) -> Mission:
    """The same flight without images, in the internal simulator, through an empty room: without images nothing would
    ever be seen free. Batteries that say nothing of themselves are taken to last for ``vehicles.battery_full_s`` where
    real vehicles fly."""
    raw = mission.model_dump()
    for table in ("transport", "localization", "metrics", "console", "start"):
        raw.pop(table)
    raw["camera"]["depth"] = False
    raw["recording"].update(enabled=False, report=False, foxglove_port=0)
    raw["simulation"].update(scene="", estimate={})
    raw["reconstruction"] = {"backend": "none"}
    raw["feedback"]["method"] = "none"
    raw["flight"]["obstacles"]["enabled"] = False
    if mission.vehicles.kind == "px4" and mission.simulation.battery.is_endless:
        hover_w = mission.simulation.battery.hover_w
        raw["simulation"]["battery"]["capacity_wh"] = hover_w * mission.vehicles.battery_full_s / JOULES_PER_WH
    raw["vehicles"]["kind"] = "simulated"
    for drone in raw["drones"]:
        drone["camera"] = ""
    return Mission.model_validate(raw)


def require_way_down(mission: Mission) -> None:
    """Raises `MissionError` where a full battery, less its reserve, does not even take a drone down from its start."""
    battery, vehicles = mission.simulation.battery, mission.vehicles
    if battery.is_endless:
        return
    usable_s = battery.hover_s * (1 - vehicles.battery_critical) / vehicles.reserve_factor
    faults = [
        f"drone {drone.id}: {battery.capacity_wh:g} Wh hover for {battery.hover_s:.0f} s, of which"
        f" vehicles.reserve_factor and battery_critical leave {usable_s:.0f} s; its way down from {drone.start[2]:g} m"
        f" alone takes {needed_s:.0f} s: it cannot reach home"
        for drone in mission.drones
        if (needed_s := landing_s(mission.flight, drone.start[2])) >= usable_s
    ]
    if faults:
        raise MissionError(faults)


def estimate(run: Run) -> Plan:
    """Of the virtual mission's run. Raises `ProcessError` for one that was cut short."""
    if run.flight is None or run.summary is None:
        raise ProcessError("the virtual flight was cut short")
    mission, flight = run.mission, run.flight
    down = flight.poses[:, :, 2] < GROUND_M
    reason = str(run.summary["exit_reason"])
    return Plan(
        mission=mission.name,
        reached=mission.stop_below == 0 or reason.startswith(REACHED),
        reason=reason,
        stop_below=mission.stop_below,
        importance=float(run.summary["J"]),
        duration_s=float(run.summary["sim_time_s"]),
        nobody_s=round(int(down.all(axis=1).sum()) * mission.tick_s, 6),
        min_separation_m=run.summary["min_separation_m"],
        drones=tuple(_drone(mission, flight, index, down[:, index]) for index in range(len(flight.drones))),
    )


def _drone(mission: Mission, flight: Flight, index: int, down: Any) -> DronePlan:
    drone, battery = int(flight.drones[index]), flight.battery[:, index]
    told = np.isfinite(flight.poses[:, index, 2])
    stood = spells(flight.time_s, down)
    endless = mission.simulation.battery.is_endless
    start = np.array(mission.drone(drone).start[:2])
    stranded = ""
    for spell in stood:
        place = flight.poses[spell.first, index]
        if np.linalg.norm(place[:2] - start) > HOME_M:
            stranded = (
                f"down at {place[0]:.1f}, {place[1]:.1f} m after {spell.start_s:.0f} s, {battery[spell.first]:.0%} left"
            )
            break
    return DronePlan(
        drone=drone,
        flight_s=round(int((told & ~down).sum()) * mission.tick_s, 6),
        batteries=None if endless else 1 + int((np.diff(battery[told]) > 0).sum()),
        least_share=None if endless else round(float(np.nanmin(np.where(down, np.nan, battery))), 4),
        swaps=tuple(Swap(spell.start_s, spell.end_s) for spell in stood if spell.behind < len(down)),
        stranded=stranded,
    )


def describe(plan: Plan) -> Iterator[str]:
    """Lines for a person."""
    if plan.stop_below > 0 and plan.reached:
        yield f"{plan.mission}: J < {plan.stop_below:g} after {plan.duration_s:.0f} s"
    else:
        yield f"{plan.mission}: J {plan.importance:.3f} after {plan.duration_s:.0f} s"
    yield f"{'drone':>5}{'flies':>9}{'batteries':>11}{'least left':>12}   swaps"
    for drone in plan.drones:
        count = "endless" if drone.batteries is None else str(drone.batteries)
        least = "" if drone.least_share is None else f"{drone.least_share:.0%}"
        swaps = ", ".join(f"{swap.start_s:.0f}-{swap.end_s:.0f} s" for swap in drone.swaps)
        yield f"{drone.drone:>5}{drone.flight_s:>7.0f} s{count:>11}{least:>12}   {swaps or 'none'}".rstrip()
    if plan.batteries is not None:
        yield f"batteries in all: {plan.batteries}; nobody in the air for {plan.nobody_s:.0f} s"
    if plan.min_separation_m is not None:
        yield f"smallest separation {plan.min_separation_m:.2f} m"
    yield "without images: what the map's feedback adds to J comes on top"
