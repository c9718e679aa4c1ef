"""How far apart predicted positions must be kept so that vehicles that lag keep the mission's distance."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from protocol.mission import Flight

SIGMAS = 3
"""How many standard deviations a position is taken to be off at most: along one direction, in 99.7 % of the cases."""
ROOT_STEPS = 40
"""Newton steps; from d + lag each at least takes a third off the distance to the root, at the end it squares it."""


def top_speed(flight: Flight) -> float:
    """Largest speed in m/s when every component is at its bound."""
    return math.sqrt(3) * flight.speed_max_mps


def position_error(flight: Flight, deviation_m: float) -> float:
    """How far an estimate of a position may be off, metres: as the mission says, or as its drone does if that is more;
    ``deviation_m``: the standard deviation that it tells."""
    return max(flight.position_error_m, SIGMAS * deviation_m)


def error_beyond(flight: Flight, deviation_m: float) -> float:
    """How much more that is than the mission says: by so much the margins of all that stands still grow."""
    return position_error(flight, deviation_m) - flight.position_error_m


def widened_separation(flight: Flight, beyond_m: float = 0.0) -> float:
    """Separation D of predicted positions that keeps the drones' positions d apart, metres; d is
    ``estimated_separation_m`` and ``beyond_m``, by which two estimates may be off more than that says, and two drones
    close in at twice their top speed."""
    return widened(flight.estimated_separation_m + beyond_m, 2 * top_speed(flight) * flight.response_time_s)


def widened(distance_m: float, lag_m: float) -> float:
    """Distance D of a predicted offset that keeps the offset itself ``distance_m`` away from the origin, metres.
    ``lag_m``: its largest speed times the lag tau.

    While the predicted offset stays at least D away from the origin and moves at most at V, its direction turns at
    most at w = V / D, and its moving average over exp(-t / tau) keeps at least D / (1 + (w tau)^2) along the
    present direction. D is the positive root of D / (1 + (V tau / D)^2) = d, that is of D^3 - d D^2 - d (V tau)^2.
    """
    distance, lag = distance_m, lag_m
    wide = distance + lag
    for _ in range(ROOT_STEPS):  # Newton's steps fall towards the root and never past it: the cubic is convex there
        wide -= (wide * wide * (wide - distance) - distance * lag * lag) / (wide * (3 * wide - 2 * distance))
    return wide
