"""What the vehicle believes: the truth in its own north, east, down, plus an error that wanders slowly, and one that
grows unless external vision corrects it."""

from __future__ import annotations

import math

import numpy as np

from sim_bridge.px4_endpoint.frames import Vector

VISION_GAIN = 0.2
"""Share of its distance to what was seen by which the position is corrected ..."""
DRIFT_GAIN = VISION_GAIN**2 / (2 - VISION_GAIN)
"""... and of what that is a second, the velocity: an alpha-beta filter without overshoot."""
GAP_S = 0.01, 0.5
"""Between two poses, at least and at most, as far as the velocity is concerned."""
WANDERING_S = 5.0
"""Time constant of the error; PX4's estimate wanders over some seconds."""


class Estimator:
    """``origin``: where its local frame has its zero, north, east, down of the world's origin, metres."""

    def __init__(self, origin: Vector, deviation_m: float, dice: np.random.Generator, drift_mps: float = 0.0) -> None:
        """``drift_mps``: how fast the position runs away, in some direction, while nothing corrects it."""
        self.origin = origin
        self._drive_deviation = math.sqrt(2) * deviation_m
        """Of the noise behind the error: filtering it once more halves its variance."""
        self._dice = dice
        self._drive: Vector = (0.0, 0.0, 0.0)
        self.error: Vector = (0.0, 0.0, 0.0)
        self.offset: Vector = (0.0, 0.0, 0.0)
        """What jumps and drift have added."""
        self._drift: Vector = (0.0, 0.0, 0.0)
        if drift_mps > 0:
            direction = dice.standard_normal(3)
            n, e, d = (drift_mps * direction / np.linalg.norm(direction)).tolist()
            self._drift = (n, e, d)
        self._seen_s = -math.inf

    def step(self, dt: float) -> None:
        o, w = self.offset, self._drift
        self.offset = (o[0] + w[0] * dt, o[1] + w[1] * dt, o[2] + w[2] * dt)
        self._wander(dt)

    def _wander(self, dt: float) -> None:
        if self._drive_deviation == 0:
            return
        keep = math.exp(-dt / WANDERING_S)
        fresh = self._drive_deviation * math.sqrt(1 - keep * keep)
        a, b, c = self._dice.standard_normal(3).tolist()
        drive = self._drive
        self._drive = (drive[0] * keep + fresh * a, drive[1] * keep + fresh * b, drive[2] * keep + fresh * c)
        rate = self._wandering
        self.error = (self.error[0] + rate[0] * dt, self.error[1] + rate[1] * dt, self.error[2] + rate[2] * dt)

    @property
    def velocity_error(self) -> Vector:
        """Derivative of all that is wrong with the position, m/s."""
        slow, w = self._wandering, self._drift
        return (slow[0] + w[0], slow[1] + w[1], slow[2] + w[2])

    @property
    def _wandering(self) -> Vector:
        w, e = self._drive, self.error
        return ((w[0] - e[0]) / WANDERING_S, (w[1] - e[1]) / WANDERING_S, (w[2] - e[2]) / WANDERING_S)

    def jump(self, by: Vector) -> None:
        """The estimate moves at once, the vehicle does not: an estimator's reset."""
        self.offset = (self.offset[0] + by[0], self.offset[1] + by[1], self.offset[2] + by[2])

    def correct(self, away: Vector, now_s: float, *, reset: bool) -> None:
        """By ``away``, how far from the estimate the vehicle was seen: a little, or ``reset``: at once."""
        if reset:
            self.jump(away)
        else:
            gap_s = min(max(now_s - self._seen_s, GAP_S[0]), GAP_S[1])
            self.jump((VISION_GAIN * away[0], VISION_GAIN * away[1], VISION_GAIN * away[2]))
            gain, w = DRIFT_GAIN / gap_s, self._drift
            self._drift = (w[0] + gain * away[0], w[1] + gain * away[1], w[2] + gain * away[2])
        self._seen_s = now_s

    def position(self, true: Vector) -> Vector:
        """Local north, east, down."""
        return (
            true[0] - self.origin[0] + self.error[0] + self.offset[0],
            true[1] - self.origin[1] + self.error[1] + self.offset[1],
            true[2] - self.origin[2] + self.error[2] + self.offset[2],
        )

    def velocity(self, true: Vector) -> Vector:
        error = self.velocity_error
        return (true[0] + error[0], true[1] + error[1], true[2] + error[2])
