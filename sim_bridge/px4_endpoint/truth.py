"""Where the vehicles truly were, for who judges a flight: ``vehicles.npz`` and ``vehicles.json`` of the run folder."""

from __future__ import annotations

import itertools
import json
import math
from array import array
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from protocol.geometry import Floats
from sim_bridge.px4_endpoint.vehicle import Vehicle

PERIOD_S = 0.05
"""Between two recorded poses."""
POSE = 5


class Truth:
    """Call `watch` after every step; `write` may be called from another thread."""

    def __init__(self, vehicles: Sequence[Vehicle]) -> None:
        self._vehicles = vehicles
        self._times = array("d")
        self._poses = array("d")
        self._due_s = -math.inf
        self._closest: dict[str, object] = {}
        self.separation_m = math.inf
        """Smallest distance of two vehicles that were both in the air."""

    def watch(self, now_s: float) -> None:
        flying = [vehicle for vehicle in self._vehicles if not vehicle.landed]
        for one, other in itertools.combinations(flying, 2):
            gap = math.dist(one.aircraft.body.position, other.aircraft.body.position)
            if gap < self.separation_m:
                self.separation_m = gap
                self._closest = {"drones": [one.drone.id, other.drone.id], "time_s": now_s}
        if now_s < self._due_s:
            return
        following_s = self._due_s + PERIOD_S
        self._due_s = following_s if now_s < following_s else now_s + PERIOD_S
        for vehicle in self._vehicles:
            self._poses.extend(vehicle.pose)
            if vehicle.armed and vehicle.mode.name == "OFFBOARD":
                vehicle.setpoints.flown(now_s)
        self._times.append(now_s)  # last: a reader counts these

    def poses(self) -> tuple[Floats, Floats]:
        """Times (n,) by CLOCK_MONOTONIC, s, and camera poses (n, drones, 5)."""
        count, drones = len(self._times), len(self._vehicles)
        poses = np.array(self._poses[: count * drones * POSE]).reshape(count, drones, POSE)
        return np.array(self._times[:count]), poses

    def summary(self) -> dict[str, object]:
        flew = math.isfinite(self.separation_m)
        return {
            "min_separation_m": self.separation_m if flew else None,
            "closest": self._closest if flew else None,
            "vehicles": {str(vehicle.drone.id): vehicle.setpoints.summary() for vehicle in self._vehicles},
        }

    def write(self, folder: Path) -> None:
        """Both files, each replaced at once."""
        times, poses = self.poses()
        ids = np.array([vehicle.drone.id for vehicle in self._vehicles])
        folder.mkdir(parents=True, exist_ok=True)
        fresh = folder / "vehicles.new.npz"
        np.savez(fresh, times=times, ids=ids, poses=poses)
        fresh.replace(folder / "vehicles.npz")
        fresh = folder / "vehicles.new.json"
        fresh.write_text(json.dumps(self.summary(), indent=2) + "\n")
        fresh.replace(folder / "vehicles.json")
