"""Between the world of `protocol.geometry` (x east, y north, z up; yaw counter-clockwise from east) and a vehicle's
north, east, down (yaw clockwise from north), and between metres and latitude and longitude as PX4 has them."""

from __future__ import annotations

import math
from typing import TypeAlias

Vector: TypeAlias = tuple[float, float, float]
Geodetic: TypeAlias = tuple[float, float, float]
"""Latitude and longitude in degrees, metres above mean sea level."""

EARTH_RADIUS_M = 6371000.0
"""Sphere of PX4's map projection (lib/geo)."""


def wrap(angle: float) -> float:
    """To [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def ned(world: tuple[float, ...]) -> Vector:
    """North, east, down of a world position or velocity; its own inverse."""
    return (world[1], world[0], -world[2])


def world_yaw(heading: float) -> float:
    """Camera yaw of a compass heading, and the reverse."""
    return wrap(math.pi / 2 - heading)


def unproject(origin: Geodetic, local: Vector) -> Geodetic:
    """Where ``local`` (north, east, down of ``origin``) lies: azimuthal equidistant projection, as PX4's."""
    latitude, longitude = math.radians(origin[0]), math.radians(origin[1])
    north, east = local[0] / EARTH_RADIUS_M, local[1] / EARTH_RADIUS_M
    distance = math.hypot(north, east)
    if distance == 0:
        return (origin[0], origin[1], origin[2] - local[2])
    sine, cosine = math.sin(distance), math.cos(distance)
    there = math.asin(cosine * math.sin(latitude) + north * sine * math.cos(latitude) / distance)
    turn = math.atan2(east * sine, distance * math.cos(latitude) * cosine - north * math.sin(latitude) * sine)
    return (math.degrees(there), math.degrees(longitude + turn), origin[2] - local[2])


def quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """w, x, y, z of the rotation yaw, then pitch, then roll (MAVLink's order)."""
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def pitch_and_yaw(q: tuple[float, ...] | list[float]) -> tuple[float, float]:
    """Of a quaternion w, x, y, z."""
    w, x, y, z = q
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    return pitch, math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
