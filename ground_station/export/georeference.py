"""Where the world frame lies on Earth, for missions that say so: metres east, north and up to latitude and longitude.

The projection is PX4's (MapProjection: azimuthal equidistant on a sphere), the same by which vehicles turned what their
receivers said into metres. With an ellipsoid's radii, positions would come out by up to 0.6 % of the distance from the
origin beside those that the vehicles flew at.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from protocol.geometry import Floats
from protocol.mission import Mission

EARTH_RADIUS_M = 6_371_000.0
"""Of PX4's sphere (CONSTANTS_RADIUS_OF_EARTH)."""


@dataclass(frozen=True, slots=True)
class Georeference:
    """Of the world frame's origin."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    """Above mean sea level."""

    @classmethod
    def of(cls, mission: Mission) -> Self | None:
        """None if the mission does not say where it is."""
        origin = mission.vehicles.origin
        return None if origin is None else cls(*origin)

    def geodetic(self, positions: Floats) -> Floats:
        """(n, 3) latitude and longitude in degrees and altitude in metres of positions (n, 3) in the world frame."""
        east, north, up = positions[:, :3].T
        east, north = east / EARTH_RADIUS_M, north / EARTH_RADIUS_M
        angle = np.hypot(east, north)
        ratio = np.sinc(angle / np.pi)  # sin(angle) / angle, 1 at the origin
        sine, cosine = np.sin(np.radians(self.latitude_deg)), np.cos(np.radians(self.latitude_deg))
        latitude = np.arcsin(np.clip(np.cos(angle) * sine + north * ratio * cosine, -1, 1))
        longitude = np.arctan2(east * ratio, cosine * np.cos(angle) - north * ratio * sine)
        turned = (self.longitude_deg + np.degrees(longitude) + 180) % 360 - 180
        return np.column_stack([np.degrees(latitude), turned, self.altitude_m + up])

    @property
    def proj(self) -> str:
        """The world frame's x and y for PROJ and the programs that use it; repr keeps every digit."""
        return (
            f"+proj=aeqd +lat_0={self.latitude_deg!r} +lon_0={self.longitude_deg!r} +R={EARTH_RADIUS_M:.0f} "
            "+units=m +no_defs"
        )

    def as_json(self) -> dict[str, Any]:
        return {
            "latitude_deg": self.latitude_deg,
            "longitude_deg": self.longitude_deg,
            "altitude_amsl_m": self.altitude_m,
            "axes": "x east, y north, z up, metres from the origin",
            "proj": self.proj,
        }
