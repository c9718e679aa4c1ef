"""Angles that a vehicle and its gimbal are told, integrated from commanded rates.

PX4 takes a velocity together with a yaw *angle*, and a gimbal takes angles. An angle that runs ahead of one that does
not follow would be caught up with at full rate later, so it is kept near what is measured.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from agents.vehicles.px4.frames import wrap

YAW_LEAD_S = 0.8
"""The yaw setpoint runs at most this much of the largest turn rate ahead. PX4's yaw controller (MC_YAW_P = 2.8 per
second) needs 0.36 s of lead to turn at a steady rate; twice that leaves room for wind."""


@dataclass(slots=True)
class AngleSetpoint:
    """``lead_rad``: bound of the distance to the measured angle; ``limits_rad``: none for a yaw, which wraps."""

    lead_rad: float
    limits_rad: tuple[float, float] | None = None
    angle_rad: float | None = None
    """None until the first `reset` or `advance`."""

    def reset(self, angle_rad: float) -> None:
        """Start anew from here."""
        low, high = self.limits_rad or (-math.inf, math.inf)
        self.angle_rad = min(max(angle_rad, low), high)

    def advance(self, rate_radps: float, elapsed_s: float, measured_rad: float) -> float:
        """Turn on for ``elapsed_s`` > 0 at ``rate_radps``; the rate that came of it, rad/s."""
        before = measured_rad if self.angle_rad is None else self.angle_rad
        wished = before + rate_radps * elapsed_s
        if self.limits_rad is None:
            ahead = wrap(wished - measured_rad)
            after = measured_rad + min(max(ahead, -self.lead_rad), self.lead_rad)
            self.angle_rad, turned = wrap(after), wrap(after - before)
        else:
            near = min(max(wished, measured_rad - self.lead_rad), measured_rad + self.lead_rad)
            self.angle_rad = min(max(near, self.limits_rad[0]), self.limits_rad[1])
            turned = self.angle_rad - before
        # The bounds may pull the setpoint back, faster than any rate that was asked for: that is no rate.
        slowest, fastest = sorted((0.0, rate_radps))
        return min(max(turned / elapsed_s, slowest), fastest)


def yaw_setpoint(turn_rate_max_radps: float) -> AngleSetpoint:
    return AngleSetpoint(min(YAW_LEAD_S * turn_rate_max_radps, math.pi / 2))
