"""The furniture of a built-in scene, thing by thing: so that a map can be told what it got right and what it missed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol.geometry import Floats
from sim_bridge.scenes.lighting import ray_caster
from sim_bridge.scenes.scene import BUILT_IN, seed_of

NO_THING = -1
"""Number of what belongs to none: floor and walls."""
ON_SURFACE_M = 1e-3
"""Farther from a thing's surface a point is not on it: baking light splits triangles, and rounds to float32."""


@dataclass(frozen=True, slots=True)
class Thing:
    name: str
    """Unlike those of the others in its scene."""
    triangles: Floats
    """[T, 3, 3] corners, metres."""


def things_of(spec: str) -> list[Thing]:
    """Of the built-in scene called ``spec``; none of what users bring, whose parts mean nothing certain."""
    if spec in BUILT_IN:
        from sim_bridge.scenes.living_room import furnish as furnish_living_room

        return _numbered([(each.name, each.surfaces.triangles) for each in furnish_living_room()])
    seed = seed_of(spec)
    if seed is None:
        return []
    from sim_bridge.scenes.random_room import furniture_of

    return _numbered([(each.name, each.surfaces.triangles) for each in furniture_of(seed)])


def thing_at(points: NDArray[np.float32], things: Sequence[Thing]) -> NDArray[np.int32]:
    """On which of ``things`` each of ``points`` [N, 3] lies, or `NO_THING`; where two touch, on either."""
    if not things or not len(points):
        return np.full(len(points), NO_THING, dtype=np.int32)
    owner = np.repeat(np.arange(len(things), dtype=np.int32), [len(thing.triangles) for thing in things])
    closest = ray_caster(np.concatenate([thing.triangles for thing in things])).compute_closest_points(points)
    apart = np.linalg.norm(closest["points"].numpy() - points, axis=1)
    owners: NDArray[np.int32] = owner[closest["primitive_ids"].numpy().astype(np.int64)]
    return np.where(apart <= ON_SURFACE_M, owners, np.int32(NO_THING))


def _numbered(found: Sequence[tuple[str, Floats]]) -> list[Thing]:
    """Chair, chair 2, chair 3."""
    seen: Counter[str] = Counter()
    things = []
    for name, triangles in found:
        seen[name] += 1
        things.append(Thing(name if seen[name] == 1 else f"{name} {seen[name]}", triangles))
    return things
