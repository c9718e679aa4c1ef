"""Strict rows of the QP: every one says ``coefficients . u >= bound`` for the commanded velocity u, (5,).

The paper's barriers assume that a drone flies the commanded velocity at once. A vehicle lags: to first order
``tau dv/dt = u - v``. Then ``y = p + tau v`` moves exactly as commanded, ``dy/dt = u``, so every barrier is built on
the *predicted* pose y, and p, a moving average of past y, stays where y stayed: inside the box exactly, and outside
the separation ball when the ball is widened as `widened_separation` says. With the rows held, y never leaves the safe
set, also when u is constant over a tick of length h <= 1/(2a): b falls at most by 2 a h b.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from agents.obstacles import Obstacles
from protocol.airspace import airspace_within
from protocol.geometry import Floats
from protocol.mission import Flight, Mission
from protocol.separation import error_beyond, top_speed, widened_separation


@dataclass(frozen=True, slots=True)
class Neighbour:
    """Another drone as last heard of; silence makes it larger, never smaller."""

    drone: int
    position: Floats
    """(3,) metres, predicted: p + tau v at the time of its state."""
    age_s: float
    """Beyond the tick at hand; 0 when its state is of this very tick."""
    error_m: float = 0.0
    """How much more than the mission says the two positions may be off, this drone's own and its; they keep so much
    farther apart."""


@dataclass(frozen=True, slots=True)
class Rows:
    """Strict rows ``coefficients @ u >= bounds``; ``barriers`` are the b that they keep from becoming negative."""

    names: tuple[str, ...]
    coefficients: Floats
    """(rows, 5)."""
    bounds: Floats
    """(rows,)."""
    barriers: Floats
    """(rows,)."""

    def of(self, kind: str) -> list[int]:
        """Which rows are of one kind: what stands before a colon in their names."""
        return [k for k, name in enumerate(self.names) if name.partition(":")[0] == kind]

    def margin(self, kind: str, without: float) -> float:
        """Smallest barrier among the rows of one kind; ``without`` if there is none."""
        chosen = self.of(kind)
        return float(self.barriers[chosen].min()) if chosen else without


def predicted_pose(pose: Floats, velocity: Floats, flight: Flight) -> Floats:
    """y = p + tau v, (5,)."""
    return pose + flight.response_time_s * velocity


REGION = ("region:-x", "region:-y", "region:-z", "region:+x", "region:+y", "region:+z")
PITCH = "pitch"
MARGIN = 2e-5
"""Distance from a strict row, in m/s or rad/s, at which a velocity surely meets it to the solver."""
SEPARATION, ZONE, OBSTACLE = "separation", "zone", "obstacle"
"""Kinds of rows: ``separation:<id>``, ``zone:<name>``, ``obstacle:<n>``."""
FIXED_ROWS = 1 + len(REGION)
"""Rows that a lone drone has."""


class Barriers:
    """The strict rows and input bounds of one drone, from a mission's flight and controller settings."""

    def __init__(self, mission: Mission) -> None:
        flight, controller = mission.flight, mission.controller
        low, high = flight.pitch_limits_rad
        self._pitch_mid, self._pitch_reach = (low + high) / 2, ((high - low) / 2) ** 2
        self._pitch_gain, self._gain = controller.pitch_gain_per_s, controller.separation_gain_per_s
        self._box = self._faces = np.concatenate([flight.lower_m, np.negative(flight.upper_m)])
        self._region = np.zeros((FIXED_ROWS, 5))
        self._region[1:4, :3], self._region[4:7, :3] = np.eye(3), -np.eye(3)
        self._flight = flight
        self._wide, self._top_speed = widened_separation(flight), top_speed(flight)
        self._deviation_m = 0.0
        self._airspace = airspace_within(flight, self._deviation_m)
        self._obstacles: Obstacles | None = None
        # A zone that is farther away is no limit: not even at top speed does its barrier shrink as fast as it may.
        self._reach_m = self._top_speed / self._gain
        self._speed = np.array(flight.velocity_limits)
        self._change = np.full(5, np.inf)
        if flight.response_time_s > 0:
            self._change = np.array(flight.acceleration_limits) * flight.response_time_s
        self._gentle_change = np.array([
            jerk * flight.response_time_s * mission.tick_s if math.isfinite(jerk) else math.inf
            for jerk in flight.jerk_limits
        ])  # fmt: skip

    def heed(self, obstacles: Obstacles) -> None:
        """From now on there are rows of these too."""
        self._obstacles = obstacles

    def note_deviation(self, deviation_m: float) -> None:
        """Standard deviation of the own position from now on: box, boundary and zones are kept from the farther, the
        more it may be off beyond what the mission says (docs/adr/0025)."""
        if deviation_m != self._deviation_m:
            self._deviation_m = deviation_m
            self._faces = self._box + error_beyond(self._flight, deviation_m)
            self._airspace = airspace_within(self._flight, deviation_m)

    def rows(self, predicted: Floats, neighbours: Sequence[Neighbour]) -> Rows:
        """All strict rows at the predicted pose (5,).

        pitch: b = ((max - min) / 2)^2 - (pitch - mid)^2 (ARCHITECTURE.md, departure 2).
        region: b = distance inside each of the six faces, less what the own estimate may be off beyond what the
        mission says.
        separation:<id>: one per neighbour (departure 7), b = |dy|^2 - D^2. Each drone's own velocity may shrink b by
        gain b; two that approach each other shrink it by twice that, and it still never becomes negative. A neighbour
        that has been silent for ``age`` keeps its place, and D grows by ``age`` times its top speed; and by what the
        two estimates may be off beyond what the mission says.
        zone:<name>: one per convex part of a zone that may be a limit, b = distance from it less D, which grows as the
        box shrinks.
        obstacle:<n>: one per box of cells that are not free and may be a limit (`agents.obstacle_rows`).
        """
        positions = np.array([neighbour.position for neighbour in neighbours]).reshape(-1, 3)
        distances = np.array([self._distance(neighbour) for neighbour in neighbours])
        coefficients, barriers = _rows(
            predicted, positions, distances, self._region, self._faces, self._pitch_mid, self._pitch_reach
        )
        bounds = -self._gain * barriers
        bounds[0] = -self._pitch_gain * barriers[0]
        names = (PITCH, *REGION, *[f"{SEPARATION}:{neighbour.drone}" for neighbour in neighbours])
        rows = Rows(names, coefficients, bounds, barriers)
        if not self._airspace.is_open:
            zones = self._airspace.barriers(predicted[:3], self._reach_m)
            labels = [f"{ZONE}:{name}" for name in zones.names]
            rows = _joined(rows, labels, zones.gradients, -self._gain * zones.values_m, zones.values_m)
        if self._obstacles is not None:
            near = self._obstacles.rows(predicted[:3])
            labels = [f"{OBSTACLE}:{k}" for k in range(len(near.bounds))]
            rows = _joined(rows, labels, np.pad(near.normals, ((0, 0), (0, 2))), near.bounds, near.barriers)
        return rows

    def _distance(self, neighbour: Neighbour) -> float:
        wide = widened_separation(self._flight, neighbour.error_m) if neighbour.error_m > 0 else self._wide
        return wide + neighbour.age_s * self._top_speed

    def velocity_bounds(self, velocity: Floats) -> tuple[Floats, Floats]:
        """Lower and upper bound of u, (5,) each: the input box U, and no more acceleration than the vehicle has.

        The lag turns a command u into the acceleration (u - v) / tau, so |u - v| <= tau x acceleration keeps the
        first-order model, on which all rows rest, true. Zero velocity always stays allowed: a drone may brake.
        """
        low = np.minimum(np.maximum(-self._speed, velocity - self._change), 0.0)
        high = np.maximum(np.minimum(self._speed, velocity + self._change), 0.0)
        return low, high

    def gentle_bounds(self, before: Floats, rows: Rows, low: Floats, high: Floats) -> tuple[Floats, Floats]:
        """``low`` and ``high`` (5,), or where the mission bounds the jerk, what of them is near the velocity (5,) that
        was commanded ``before``: a change of the command is one of the acceleration, times the lag.

        Comfort never stands against safety: a tick in which even the slowest of these velocities breaks a strict row,
        or comes so near to it as solutions do, is flown without. So whoever may stop, can.
        """
        if np.isinf(self._gentle_change).all():
            return low, high
        near_low, near_high = (
            np.maximum(low, before - self._gentle_change),
            np.minimum(high, before + self._gentle_change),
        )
        if (near_low > near_high).any():  # the vehicle is not where the command would have it
            return low, high
        slowest = np.clip(0.0, near_low, near_high)
        kept = MARGIN * np.linalg.norm(rows.coefficients, axis=1)
        is_safe = bool((rows.coefficients @ slowest >= rows.bounds + kept).all())
        return (near_low, near_high) if is_safe else (low, high)


def _joined(rows: Rows, names: Sequence[str], coefficients: Floats, bounds: Floats, barriers: Floats) -> Rows:
    return Rows(
        (*rows.names, *names),
        np.concatenate([rows.coefficients, coefficients]),
        np.concatenate([rows.bounds, bounds]),
        np.concatenate([rows.barriers, barriers]),
    )


@njit(cache=True, nogil=True)
def _rows(
    predicted: Floats,
    positions: Floats,
    distances: Floats,
    region: Floats,
    faces: Floats,
    pitch_mid: float,
    pitch_reach: float,
) -> tuple[Floats, Floats]:
    """Coefficients (rows, 5) and barriers (rows,): pitch, six faces, and one for each of ``positions`` (n, 3)."""
    count = FIXED_ROWS + positions.shape[0]
    coefficients, barriers = np.zeros((count, 5)), np.empty(count)
    coefficients[:FIXED_ROWS] = region
    away = predicted[4] - pitch_mid
    coefficients[0, 4] = -2 * away
    barriers[0] = pitch_reach - away * away
    for axis in range(3):
        barriers[1 + axis] = predicted[axis] - faces[axis]
        barriers[4 + axis] = -predicted[axis] - faces[3 + axis]
    for k in range(positions.shape[0]):
        square = 0.0
        for axis in range(3):
            offset = predicted[axis] - positions[k, axis]
            coefficients[FIXED_ROWS + k, axis] = 2 * offset
            square += offset * offset
        barriers[FIXED_ROWS + k] = square - distances[k] * distances[k]
    return coefficients, barriers
