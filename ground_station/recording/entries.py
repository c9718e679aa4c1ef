"""What a recording holds of the ground station's inputs and decisions, in the order in which they came about.

From these, and the mission, phi and the map can be made again to the last bit; the rest of a recording is for people
to look at. Entries come in the order of the file: a jump takes effect at its own tick, before that tick is integrated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

from protocol import messages
from protocol.geometry import Floats

KeyframeName: TypeAlias = tuple[int, int]
"""Drone and sequence number."""


@dataclass(frozen=True, slots=True, eq=False)
class HandOver:
    """Keyframes that were given to the map."""

    tick: int
    keyframes: tuple[messages.Keyframe, ...]
    """In the map's order; poses to the last bit, JPEGs as they came."""
    missing: tuple[KeyframeName, ...] = ()
    """Those of them that the recording lacks: the map cannot be made again exactly."""


@dataclass(frozen=True, slots=True)
class Look:
    """A map update was begun, of all that was handed over before."""

    tick: int
    importance: float
    """J after this tick was integrated; whether the map's change makes phi jump depends on it."""


@dataclass(frozen=True, slots=True, eq=False)
class IntegratedTick:
    """phi went on by one tick."""

    tick: int
    ids: tuple[int, ...]
    poses: Floats
    """(drones, 5) float64, row by row of ``ids``: x, y, z, camera yaw, camera pitch."""


@dataclass(frozen=True, slots=True, eq=False)
class JumpRecord:
    """A jump that was told to the team."""

    look: int
    """Tick of the `Look` that it came from."""
    jump: messages.Jump
    """``jump.tick``: when it takes effect."""


Input: TypeAlias = HandOver | Look | IntegratedTick | JumpRecord
