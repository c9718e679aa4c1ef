"""Tells the autopilot where it was seen from outside, as VISION_POSITION_ESTIMATE, which its EKF fuses (EKF2_EV_CTRL).

MAVSDK 4.1.0 passes that message's stamp on as it is and answers no TIMESYNC, so PX4, which then does not know our
clock, takes the pose for one of the moment of its arrival, less EKF2_EV_DELAY. Positions are north, east, down of the
local frame, and so are the axes that the attitude refers to, though MAVSDK calls them the body's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Final

from mavsdk import System
from mavsdk.plugins.mocap import AngleBody, Covariance, Mocap, PositionBody, VisionPositionEstimate

from agents.vehicles.px4 import frames
from agents.vehicles.px4.refusals import refusals
from agents.vehicles.vehicle import SeenPose

RATE_MAX_HZ: Final = 50.0
"""PX4 asks for 30 to 50."""
EARLY: Final = 0.5
"""Share of a period by which one may come too early: cameras are not in step with us."""
RESETS: Final = 256
"""Its counter has a byte."""


class ExternalPoseLink:
    """Used from the event loop's thread."""

    def __init__(self, system: System, now_s: Callable[[], float], unix_s: Callable[[], float] | None = None) -> None:
        """``now_s``: the clock of `SeenPose.at_s`; ``unix_s``: the machine's own, of the message's stamps.

        Raises:
            VehicleError: the connection is gone.
        """
        self._now_s, self._unix_s = now_s, unix_s or (lambda: datetime.now(UTC).timestamp())
        with refusals("attaching to the vehicle"):
            self._mocap = Mocap(system)
        self._due_s, self._resets = -math.inf, 0
        self.sent_s: float | None = None
        """When the newest one went; None before the first."""

    def send(self, seen: SeenPose) -> None:
        """Unless it comes sooner after the last one than PX4 wants them, or is older.

        Raises:
            VehicleError: the connection is gone.
        """
        period_s = 1 / RATE_MAX_HZ
        if seen.at_s < self._due_s - EARLY * period_s and seen.resets == self._resets:
            return
        self._due_s = max(self._due_s, seen.at_s) + period_s
        self._resets = seen.resets
        with refusals("passing a pose on"):
            self._mocap.set_vision_position_estimate(self._message(seen))
        self.sent_s = self._now_s()

    def _message(self, seen: SeenPose) -> VisionPositionEstimate:
        north, east, down = frames.ned_vector(seen.position).tolist()
        roll_rad, pitch_rad, yaw_rad = frames.ned_attitude(seen.rotation)
        age_s = max(0.0, self._now_s() - seen.at_s)
        return VisionPositionEstimate(
            round(1e6 * (self._unix_s() - age_s)),
            PositionBody(north, east, down),
            AngleBody(roll_rad, pitch_rad, yaw_rad),
            Covariance(upper_triangle(seen.position_sd_m, seen.angle_sd_rad)),
            seen.resets % RESETS,
        )


def upper_triangle(position_sd_m: float, angle_sd_rad: float) -> list[float]:
    """The 21 numbers of a diagonal 6 x 6 covariance, row by row from the diagonal on."""
    variances = [position_sd_m**2] * 3 + [angle_sd_rad**2] * 3
    return [variances[row] if column == row else 0.0 for row in range(6) for column in range(row, 6)]
