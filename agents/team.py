"""The other drones as obstacles: whoever was once heard of, or is in the mission, never vanishes by falling silent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from agents.barriers import Neighbour, predicted_pose
from protocol.geometry import Floats
from protocol.messages import DroneState
from protocol.mission import Flight
from protocol.separation import position_error
from protocol.team_states import Sighting


@dataclass(frozen=True, slots=True)
class _Seen:
    tick: int
    pose: Sequence[float]
    velocity: Sequence[float]
    blind_s: float = 0.0
    landed: bool = False
    """Then it stays where it is, also when its process has ended."""
    position_sd_m: float = 0.0
    climb_m: float = 0.0
    """So far up it is about to climb by itself, without giving way."""


class Team:
    """``starts`` are poses of the whole team, so that a drone that never speaks is an obstacle at its start."""

    def __init__(self, own: int, starts: Mapping[int, Sequence[float]], flight: Flight, tick_s: float) -> None:
        self._own, self._flight, self._tick_s = own, flight, tick_s
        self._last_seen = {drone: _Seen(0, start, (0.0,) * 5) for drone, start in starts.items() if drone != own}
        self._seen_before: dict[int, _Seen] = {}

    def hear(self, state: DroneState | Sighting, now: int) -> None:
        """``now``: this drone's own newest tick. An older state never replaces a newer one, and none is younger than
        its arrival, give or take the tick that its sender may have heard first: a clock that is ahead must not hide
        that its drone fell silent."""
        known = self._last_seen.get(state.drone)
        if state.drone != self._own and (known is None or known.tick <= state.tick):
            tick = min(state.tick, now + 1)
            if known is not None and known.tick < tick:
                self._seen_before[state.drone] = known
            self._last_seen[state.drone] = _Seen(
                tick, state.pose, state.velocity, state.blind_s, state.landed, state.position_sd_m, state.climb_m or 0.0
            )

    def places(self, tick: int) -> Floats:
        """(n, 4) x, y, z where the others last said, before ``tick``, that they were, and the standard deviation; in
        lockstep the same, whoever speaks first."""
        said = [
            seen if seen.tick < tick else self._seen_before.get(drone, seen)
            for drone, seen in sorted(self._last_seen.items())
        ]
        return np.array([(*seen.pose[:3], seen.position_sd_m) for seen in said]).reshape(-1, 4)

    def neighbours(
        self, tick: int, delay_s: float = 0.0, position_sd_m: float = 0.0, height_m: float = 0.0
    ) -> list[Neighbour]:
        """All the others at ``tick``, ascending by id; the longer silent, the larger, and the longer ``delay_s``, the
        time until a command is flown: until then either may move on. ``position_sd_m``: this drone's own, and
        ``height_m`` its predicted z: one that climbs by itself is everywhere on its way up, so where it is nearest."""
        others = sorted(self._last_seen.items())
        poses = np.array([seen.pose for _, seen in others]).reshape(-1, 5)
        velocities = np.array([seen.velocity for _, seen in others]).reshape(-1, 5)
        predicted = predicted_pose(poses, velocities, self._flight)
        for row, (_, seen) in enumerate(others):
            if seen.climb_m > 0:
                low_m = predicted[row, 2]
                predicted[row, 2] = min(max(height_m, low_m), max(low_m, seen.pose[2] + seen.climb_m))
        own_m = position_error(self._flight, position_sd_m) - 2 * self._flight.position_error_m
        return [
            Neighbour(
                drone,
                predicted[row, :3],
                self._silence_s(seen, tick) + delay_s,
                own_m + position_error(self._flight, seen.position_sd_m),
            )
            for row, (drone, seen) in enumerate(others)
        ]

    def _silence_s(self, seen: _Seen, tick: int) -> float:
        """In which it may have moved without a word."""
        return 0.0 if seen.landed else max(0, tick - seen.tick) * self._tick_s + seen.blind_s
