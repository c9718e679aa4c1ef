"""What must hold before a vehicle takes off: each item has a name, and a reason when it is red. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from agents.vehicles.px4.gimbal import Aim
from agents.vehicles.px4.telemetry_slots import Health, Pointing
from protocol.geometry import Floats
from protocol.mission import Mission


@dataclass(frozen=True, slots=True)
class Readings:
    """What is known of a vehicle; None of what was not heard, or is too old."""

    position: Floats | None
    """(3,), world; None also while the local frame's place in the world is unknown."""
    has_attitude: bool
    mode: str | None
    landed: str | None
    armed: bool | None
    battery: float | None
    health: Health | None
    pointing: Pointing | None = None
    seen: bool | None = None
    """Whether poses from outside come; None where none are asked for."""
    undone: Mapping[str, str] | None = None
    """Steps of the preparation that have not succeeded yet, and why: "parameters", "gimbal", ..."""

    @property
    def is_airborne(self) -> bool:
        return self.landed in ("IN_AIR", "TAKING_OFF", "LANDING")


@dataclass(frozen=True, slots=True)
class Item:
    name: str
    fault: str
    """Why it is red; empty when it is green."""


def checklist(readings: Readings, mission: Mission, drone: int, aim: Aim | None, *, again: bool = False) -> list[Item]:
    """All items, in the order in which a person would look. ``aim``: where the gimbal is told to point, if there is
    one. ``again``: it has flown already, and may have come down elsewhere than at its start. A vehicle found in the air
    is asked only for what flying it takes."""
    items = [_heard(readings)]
    if readings.seen is not None:
        items.append(Item("motion capture", "" if readings.seen else "no poses of this drone come"))
    items += [Item(name, fault) for name, fault in (readings.undone or {}).items()]
    items += _health(readings, mission)
    if readings.is_airborne:
        return items
    items += [_on_ground(readings), _battery(readings, mission), *_place(readings, mission, drone)[again:]]
    if aim is not None:
        items.append(_gimbal(readings, mission, aim))
    return items


def red(items: list[Item]) -> list[Item]:
    return [item for item in items if item.fault]


def _heard(readings: Readings) -> Item:
    heard = {
        "position": readings.position is not None,
        "attitude": readings.has_attitude,
        "flight mode": readings.mode is not None,
        "armed or not": readings.armed is not None,
        "landed or not": readings.landed not in (None, "UNKNOWN"),
    }
    silent = [name for name, there in heard.items() if not there]
    return Item("telemetry", "not heard: " + ", ".join(silent) if silent else "")


def _health(readings: Readings, mission: Mission) -> list[Item]:
    health = readings.health
    if health is None:
        return [Item("health", "not reported")]
    items = [Item("local position", "" if health.local_position else "not estimated")]
    if mission.vehicles.origin is not None:
        items.append(Item("global position", "" if health.global_position else "not estimated; GPS?"))
    if readings.is_airborne:
        return items
    calibrated = {"gyroscope": health.gyroscope, "accelerometer": health.accelerometer}
    if mission.vehicles.origin is not None:  # a vehicle placed by motion capture may fly without them
        calibrated["magnetometer"] = health.magnetometer
        items.append(Item("home position", "" if health.home else "not set"))
    items += [Item(name, "" if fine else "not calibrated or not healthy") for name, fine in calibrated.items()]
    items.append(Item("armable", "" if health.armable else "the autopilot's own checks fail; see its status texts"))
    return items


def _on_ground(readings: Readings) -> Item:
    if readings.armed and readings.landed == "ON_GROUND":
        return Item("disarmed", "armed on the ground, by somebody else")
    return Item("disarmed", "")


def _battery(readings: Readings, mission: Mission) -> Item:
    share, least = readings.battery, mission.vehicles.battery_low
    if share is None:
        return Item("battery", "not reported")
    return Item("battery", "" if share > least else f"{share:.0%} left, must exceed {least:.0%}")


def _place(readings: Readings, mission: Mission, drone: int) -> list[Item]:
    """Horizontally, and the height."""
    if readings.position is None:
        return []
    x, y, z = readings.position.tolist()
    start = mission.drone(drone).start
    away, tolerance = math.hypot(x - start[0], y - start[1]), mission.vehicles.start_tolerance_m
    place = "" if away <= tolerance else f"{away:.2f} m from ({start[0]:g}, {start[1]:g}), at most {tolerance:g} m"
    height = "" if z < start[2] else f"stands at {z:.2f} m, not below the {start[2]:g} m to climb to"
    return [Item("start place", place), Item("start height", height)]


def _gimbal(readings: Readings, mission: Mission, aim: Aim) -> Item:
    if readings.pointing is None:
        return Item("gimbal", "its attitude is not heard")
    error_rad, most_rad = aim.error_rad(readings.pointing), mission.vehicles.gimbal_error_rad
    if error_rad <= most_rad:
        return Item("gimbal", "")
    told, points = math.degrees(aim.pitch_rad), -math.degrees(readings.pointing.pitch_rad)
    return Item("gimbal", f"told to look {told:.0f} degrees down, looks {points:.0f}; is its range too small?")
