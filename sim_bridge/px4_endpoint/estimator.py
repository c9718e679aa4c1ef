"""What the vehicle believes: the truth in its own north, east, down, plus an error that wanders slowly."""

from __future__ import annotations

import math

import numpy as np

from sim_bridge.px4_endpoint.frames import Vector

WANDERING_S = 5.0
"""Time constant of the error; PX4's estimate wanders over some seconds."""


class Estimator:
    """``origin``: where its local frame has its zero, north, east, down of the world's origin, metres."""

    def __init__(self, origin: Vector, deviation_m: float, dice: np.random.Generator) -> None:
        self.origin = origin
        self._drive_deviation = math.sqrt(2) * deviation_m
        """Of the noise behind the error: filtering it once more halves its variance."""
        self._dice = dice
        self._drive: Vector = (0.0, 0.0, 0.0)
        self.error: Vector = (0.0, 0.0, 0.0)
        self.offset: Vector = (0.0, 0.0, 0.0)
        """What jumps have added."""

    def step(self, dt: float) -> None:
        if self._drive_deviation == 0:
            return
        keep = math.exp(-dt / WANDERING_S)
        fresh = self._drive_deviation * math.sqrt(1 - keep * keep)
        a, b, c = self._dice.standard_normal(3).tolist()
        drive = self._drive
        self._drive = (drive[0] * keep + fresh * a, drive[1] * keep + fresh * b, drive[2] * keep + fresh * c)
        rate = self.velocity_error
        self.error = (self.error[0] + rate[0] * dt, self.error[1] + rate[1] * dt, self.error[2] + rate[2] * dt)

    @property
    def velocity_error(self) -> Vector:
        """Derivative of the error, m/s."""
        w, e = self._drive, self.error
        return ((w[0] - e[0]) / WANDERING_S, (w[1] - e[1]) / WANDERING_S, (w[2] - e[2]) / WANDERING_S)

    def jump(self, by: Vector) -> None:
        """The estimate moves at once, the vehicle does not: an estimator's reset."""
        self.offset = (self.offset[0] + by[0], self.offset[1] + by[1], self.offset[2] + by[2])

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
