"""A landed drone's other battery: whether one is waited for, when it is in, and when the way up is free.

The crew changes the battery; that it has is seen from the share that rose on the ground, disarmed. Then the drone takes
off by the vehicle's own means, straight up, without giving way. So it first waits until nobody is near its way up, and
says that it will climb (`protocol.messages.DroneState.climb_m`): to the others it is everywhere on that way at once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from agents.barriers import Neighbour
from agents.policies import Order
from agents.vehicles.vehicle import Authority, Telemetry
from protocol.geometry import Floats
from protocol.messages import DroneOrder
from protocol.mission import Mission
from protocol.news import Tell
from protocol.separation import top_speed, widened_separation

ENERGY = ("battery reserve", "battery low", "battery critical")
"""Policies after which a drone that has landed waits for another battery."""
RISE = 0.1
"""A share that rose by so much on the ground is another battery's; a resting one recovers by a few per cent."""
MOVED_M = 0.5
"""Who thinks on the ground to have moved so far knows its place no more: a vehicle that lost power begins anew."""
SPARE_M = 0.3
"""So much beyond the separation nobody may be, before a drone says that it will climb: what the others fly on until
they have heard it."""
PATIENCE_S = 10.0
"""It waits no longer for that, but says so; then the others have to go."""


class Swap:
    """Of one drone; asked every tick that the vehicle does not fly for us."""

    def __init__(self, mission: Mission, drone: int, tell: Tell) -> None:
        """``tell``: who wants to know of what happens."""
        vehicles = mission.vehicles
        self._wanted, self._spares = vehicles.battery_swap_s > 0, vehicles.battery_spares
        self._by_itself = vehicles.kind == "simulated" or vehicles.swapped == "at_once"
        self._enough = max(vehicles.battery_low, vehicles.battery_critical)
        self._room_m, self._top_speed_mps = widened_separation(mission.flight), top_speed(mission.flight)
        self._start_m, self._tell = mission.drone(drone).start[2], tell
        self._cause, self._stays = "", False
        self._landed: tuple[Floats, float, int] | None = None
        """Place (3,), least share, and number of the newest order since it has stood on the ground."""
        self._full_told = self._displaced_told = self._is_displaced = False
        self._ready_s = math.inf
        self.count = 0
        """Batteries changed so far."""
        self.climbs = False
        """Whether the way up is the drone's own by now."""

    def note(self, order: Order, *, stays: bool) -> None:
        """``order``: the policies' newest; the last one before the landing says why it comes down. ``stays``: the
        mission is over for it."""
        if order.action in ("return", "land") and order.policy != "landing":
            self._cause = order.policy
        self._stays = stays

    @property
    def is_awaited(self) -> bool:
        """Whether a landed drone stands on the ground only until it has another battery."""
        return self._wanted and self._cause in ENERGY and self._spares != 0 and not self._stays

    def is_done(self, telemetry: Telemetry, authority: Authority, operator: DroneOrder) -> bool:
        """Whether it has another battery, and may fly on. ``operator``: the newest order."""
        if authority != "landed" or not self.is_awaited:
            return False
        if self._landed is None:
            self._tell("info", "battery", f"on the ground at {telemetry.battery:.0%}: waits for another battery")
            self._landed = telemetry.pose[:3].copy(), telemetry.battery, operator.number
        place, least, number = self._landed
        self._landed = place, min(least, telemetry.battery), number
        moved_m = math.dist(place, telemetry.pose[:3])
        self._is_displaced = moved_m > max(MOVED_M, 3 * telemetry.position_sd_m)
        if self._is_displaced:
            if not self._displaced_told:
                self._tell("error", "battery", f"its estimate moved by {moved_m:.1f} m on the ground: stays there")
                self._displaced_told = True
            return False
        if telemetry.battery < min(1.0, least + RISE) or telemetry.battery <= self._enough:
            return False
        if not self._full_told:
            self._tell("info", "battery", f"another battery is in, at {telemetry.battery:.0%}")
            self._full_told = True
        return self._by_itself or (operator.number > number and operator.action == "fly")

    def as_it_stands(self, telemetry: Telemetry) -> Telemetry:
        """What the others are told: one that no longer knows its place stands where it landed."""
        if self._landed is None or not self._is_displaced:
            return telemetry
        pose = telemetry.pose.copy()
        pose[:3] = self._landed[0]
        return replace(telemetry, pose=pose)

    def renew(self, now_s: float) -> None:
        """The vehicle is ready to fly on, from ``now_s``, by the clock of the telemetry's stamps."""
        self._cause, self._landed, self._full_told, self._ready_s = "", None, False, now_s
        self._displaced_told = False
        self._spares = None if self._spares is None else self._spares - 1
        self.count += 1

    def may_climb(self, telemetry: Telemetry, neighbours: Sequence[Neighbour]) -> bool:
        """Whether a drone that is ready again may take off now. ``neighbours``: with their places, not with their ways
        up."""
        room_m = min((self._room_of(telemetry.pose, neighbour) for neighbour in neighbours), default=math.inf)
        if self.climbs:
            return room_m >= 0
        self.climbs = room_m >= SPARE_M or telemetry.stamp_s - self._ready_s > PATIENCE_S
        return False  # first the others have to hear it

    def climb_m(self, telemetry: Telemetry, authority: Authority) -> float:
        """How far up its way is taken (`DroneState.climb_m`)."""
        if authority not in ("ready", "starting"):
            self.climbs = False
        return max(0.0, self._start_m - float(telemetry.pose[2])) if self.climbs else 0.0

    def _room_of(self, pose: Floats, neighbour: Neighbour) -> float:
        """How much farther ``neighbour``, or wherever it may have flown in silence, is from the way up than it must be,
        metres."""
        offset = neighbour.position - pose[:3]
        offset[2] -= np.clip(offset[2], 0.0, max(0.0, self._start_m - float(pose[2])))
        return float(np.linalg.norm(offset)) - self._room_m - neighbour.error_m - neighbour.age_s * self._top_speed_mps
