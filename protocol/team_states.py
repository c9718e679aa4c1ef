"""A team's states in one message: how the router packs them, and how who hears it takes them apart."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.errors import MessageError
from protocol.messages import DroneState, TeamStates, Vector5

POSE_MAX = 1e6
"""Of a coordinate, as in `protocol.messages.Coordinate`."""
BLIND_MAX_S = 60.0
"""As in `protocol.messages.DroneState.blind_s`."""

TimedPose = tuple[int, Vector5]
"""Tick and pose."""


@dataclass(frozen=True, slots=True)
class Sighting:
    """What a state says of where its drone is: all that the others fly by. `DroneState` has the same fields."""

    drone: int
    tick: int
    pose: Vector5
    velocity: Vector5
    blind_s: float
    landed: bool
    earlier: Sequence[TimedPose]
    position_sd_m: float = 0.0
    climb_m: float = 0.0


def pack(states: Iterable[tuple[DroneState, Sequence[TimedPose]]]) -> TeamStates:
    """Newest states with what is to be repeated besides, ascending by drone."""
    told = list(states)
    newest = [state for state, _ in told]
    earlier = [(row, *timed) for row, (_, poses) in enumerate(told) for timed in poses]
    return TeamStates(
        drones=np.array([state.drone for state in newest], np.uint8),
        ticks=np.array([state.tick for state in newest], np.int32),
        poses=_five([state.pose for state in newest]),
        velocities=_five([state.velocity for state in newest]),
        blind_s=np.array([state.blind_s for state in newest], np.float64),
        landed=np.array([state.landed for state in newest], np.uint8),
        earlier_rows=np.array([row for row, _, _ in earlier], np.uint8),
        earlier_ticks=np.array([tick for _, tick, _ in earlier], np.int32),
        earlier_poses=_five([pose for _, _, pose in earlier]),
        position_sd_m=np.array([state.position_sd_m for state in newest], np.float64),
        climb_m=np.array([state.climb_m or 0.0 for state in newest], np.float64),
    )


def unpack(message: TeamStates) -> list[Sighting]:
    """The newest of each drone.

    Raises:
        MessageError: the arrays do not fit each other, or hold what no state may.
    """
    count, repeated = message.drones.size, message.earlier_rows.size
    deviations = np.zeros(count) if message.position_sd_m is None else message.position_sd_m
    climbs = np.zeros(count) if message.climb_m is None else message.climb_m
    for array, dtype, shape in (
        (message.drones, np.uint8, (count,)),
        (message.ticks, np.int32, (count,)),
        (message.poses, np.float64, (count, 5)),
        (message.velocities, np.float64, (count, 5)),
        (message.blind_s, np.float64, (count,)),
        (message.landed, np.uint8, (count,)),
        (message.earlier_rows, np.uint8, (repeated,)),
        (message.earlier_ticks, np.int32, (repeated,)),
        (message.earlier_poses, np.float64, (repeated, 5)),
        (deviations, np.float64, (count,)),
        (climbs, np.float64, (count,)),
    ):
        if array.dtype != dtype or array.shape != shape:
            raise MessageError(f"team_states: {array.dtype} of shape {array.shape} instead of {dtype.__name__} {shape}")
    _require(bool((message.drones >= 1).all()), "a drone without an id")
    _require(bool((message.earlier_rows < count).all()), "poses of nobody")
    _require(_within(message.ticks, 0, np.inf) and _within(message.earlier_ticks, 0, np.inf), "a tick before the first")
    _require(_within(message.blind_s, 0, BLIND_MAX_S), "a time without telemetry that is too long")
    _require(_within(deviations, 0, POSE_MAX), "a standard deviation that is none")
    _require(_within(climbs, 0, POSE_MAX), "a climb that is none")
    for array in (message.poses, message.velocities, message.earlier_poses):
        _require(_within(array, -POSE_MAX, POSE_MAX), "a coordinate that is too large")
    earlier: list[list[TimedPose]] = [[] for _ in range(count)]
    for row, tick, pose in zip(
        message.earlier_rows.tolist(), message.earlier_ticks.tolist(), message.earlier_poses.tolist(), strict=True
    ):
        earlier[row].append((tick, tuple(pose)))
    columns = (
        message.drones, message.ticks, message.poses, message.velocities, message.blind_s, message.landed, deviations,
        climbs,
    )  # fmt: skip
    return [
        Sighting(drone, tick, tuple(pose), tuple(velocity), blind_s, bool(landed), poses, deviation, climb)
        for drone, tick, pose, velocity, blind_s, landed, deviation, climb, poses in zip(
            *(column.tolist() for column in columns), earlier, strict=True
        )
    ]


def _five(rows: Sequence[Vector5]) -> NDArray[np.float64]:
    return np.array(rows, np.float64).reshape(len(rows), 5)


def _within(array: NDArray[Any], low: float, high: float) -> bool:
    return bool(((array >= low) & (array <= high)).all())


def _require(fits: bool, fault: str) -> None:
    if not fits:
        raise MessageError(f"team_states: {fault}")
