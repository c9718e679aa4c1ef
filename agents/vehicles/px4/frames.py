"""Between the world frame and a PX4 vehicle's local frame: one place, because a wrong sign flies into a wall.

World: x east, y north, z up; camera yaw counter-clockwise from east, pitch is the depression (`protocol.geometry`).
Vehicle: north, east, down (NED) from an origin of its own; yaw clockwise from north; body forward, right, down (FRD).
A gimbal's pitch is positive upwards, so it is the negative depression.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from protocol.geometry import Floats

EARTH_RADIUS_M = 6_371_000.0
"""Of the sphere onto which PX4 projects (CONSTANTS_RADIUS_OF_EARTH). With the ellipsoid's own radii, up to 0.6 % larger
or smaller, two vehicles with different origins would disagree about one place; with PX4's they agree."""

NED_TO_WORLD: Floats = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""Also its own inverse."""


@dataclass(frozen=True, slots=True)
class GlobalPosition:
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    """Above mean sea level."""


def wrap(angle_rad: float) -> float:
    """The same angle in [-pi, pi)."""
    return (angle_rad + math.pi) % (2 * math.pi) - math.pi


def world_yaw(ned_yaw_rad: float) -> float:
    """Counter-clockwise from east, of an angle clockwise from north, wrapped; also the other way round."""
    return wrap(math.pi / 2 - ned_yaw_rad)


ned_yaw = world_yaw


def world_vector(ned: Floats) -> Floats:
    """A direction or velocity (3,) in the world, of one in NED; also the other way round."""
    rotated: Floats = NED_TO_WORLD @ ned
    return rotated


ned_vector = world_vector


def offset(origin: GlobalPosition, local_origin: GlobalPosition) -> Floats:
    """World position (3,) of a local frame's origin, where the world's own lies at ``origin``.

    Azimuthal equidistant projection, as PX4's MapProjection: the tangent plane, to a millimetre in a kilometre.
    """
    lat0, lat1 = math.radians(origin.latitude_deg), math.radians(local_origin.latitude_deg)
    east = wrap(math.radians(local_origin.longitude_deg - origin.longitude_deg))
    # The haversine keeps its precision at distances of millimetres, where an arc cosine has none left.
    half = math.sin((lat1 - lat0) / 2) ** 2 + math.cos(lat0) * math.cos(lat1) * math.sin(east / 2) ** 2
    angle = 2 * math.asin(math.sqrt(min(1.0, half)))
    scale = EARTH_RADIUS_M * (angle / math.sin(angle) if angle > 0 else 1.0)
    # sin(lat1 - lat0) + ..., not cos sin - sin cos: likewise.
    north = math.sin(lat1 - lat0) + 2 * math.sin(lat0) * math.cos(lat1) * math.sin(east / 2) ** 2
    return np.array(
        [
            scale * math.cos(lat1) * math.sin(east),
            scale * north,
            local_origin.altitude_m - origin.altitude_m,
        ]
    )


@dataclass(frozen=True, slots=True)
class LocalFrame:
    """A vehicle's local NED frame; ``origin`` (3,) is where it lies in the world."""

    origin: Floats

    def to_world(self, ned: Floats) -> Floats:
        """Position (3,)."""
        return self.origin + world_vector(ned)

    def to_local(self, world: Floats) -> Floats:
        """Position (3,)."""
        return ned_vector(world - self.origin)


def body_rotation(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Floats:
    """FRD to NED, (3, 3), of a 3-2-1 sequence as MAVLink's ATTITUDE has it."""
    cr, sr = math.cos(roll_rad), math.sin(roll_rad)
    cp, sp = math.cos(pitch_rad), math.sin(pitch_rad)
    cy, sy = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def ned_attitude(body_to_world: Floats) -> tuple[float, float, float]:
    """Roll, pitch and yaw, 3-2-1 sequence, FRD to NED, of a rotation (3, 3) whose body axes are forward, left, up."""
    rotation = NED_TO_WORLD @ body_to_world @ np.diag([1.0, -1.0, -1.0])
    return (
        math.atan2(rotation[2, 1], rotation[2, 2]),
        math.asin(min(1.0, max(-1.0, -rotation[2, 0]))),
        math.atan2(rotation[1, 0], rotation[0, 0]),
    )


def fixed_camera_rotation(roll_rad: float, pitch_rad: float, yaw_rad: float, depression_rad: float) -> Floats:
    """Camera to world, (3, 3), of a camera fixed to an airframe with this attitude, looking ``depression_rad`` below
    its nose. Level, it is `protocol.geometry.camera_rotation`."""
    low, ahead = math.sin(depression_rad), math.cos(depression_rad)
    camera_to_body = np.array([[0.0, -low, ahead], [1.0, 0.0, 0.0], [0.0, ahead, low]])
    rotation: Floats = NED_TO_WORLD @ body_rotation(roll_rad, pitch_rad, yaw_rad) @ camera_to_body
    return rotation


def turn_rate(roll_rad: float, pitch_rad: float, q_radps: float, r_radps: float) -> float:
    """Rate of the world yaw, rad/s, from the body rates q (about the right axis) and r (about down).

    Euler's kinematic equation; level with the horizon it is -r.
    """
    return -(math.sin(roll_rad) * q_radps + math.cos(roll_rad) * r_radps) / math.cos(pitch_rad)
