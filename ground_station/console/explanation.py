"""Why a drone goes where it goes: the places whose importance pulls it, and what its strict rows forbid."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ground_station.console.attraction import Attraction, attraction
from ground_station.console.constraints import all_in_words, margin
from protocol.geometry import Floats
from protocol.importance import ImportanceField
from protocol.messages import Control, DroneState, Vector3, Vector5
from protocol.mission import Sensing
from protocol.planner_settings import FREE_AXES, PlannerName

PLACE_RADIUS_M: Final = 0.4
"""Neighbouring cells pull alike: those so near to the strongest are told as one place."""
STEERED: Final = ("flying", "braking")
"""Modes in which the planner decides where a drone goes."""
OTHERS: Final[dict[PlannerName, str]] = {
    "lawnmower": "sweeps strip by strip with the camera straight down, whatever is of importance",
    "persistent": "goes by a field of its own, in which importance returns where nobody looks",
    "angle_aware_down": "feels the pull along x and y alone, at one height with the camera straight down",
    "angle_aware": "feels the pull along x and y and in the turning of its camera, at one height",
}
"""What the planners that the paper compares with do, in words that follow their name."""
STILL_MPS: Final = 0.01
"""Slower is no motion to speak of."""
STILL_RADPS: Final = 0.01


@dataclass(frozen=True, slots=True)
class Pull:
    """A place of the field, and its part of xi1."""

    position: Vector3
    """m, world; the middle of its cells, weighted by how much they pull."""
    importance: float
    """Mean phi over its positions and all directions."""
    vector: Vector3
    """Its part of xi1, 1/(s m): where to it pulls the drone."""
    share: float
    """Of all that pulls the way of the sum: in (0, 1], and 1 for all places together."""


@dataclass(frozen=True, slots=True)
class Explanation:
    drone: int
    tick: int
    """Of the state that is explained."""
    pulls: tuple[Pull, ...]
    """Largest share first."""
    opposed: float
    """How much of what they pull is cancelled by cells that pull back, 0 to 1."""
    xi1: Vector5
    """delta_1 sum over own cells of (dh1/dp) phi, 1/(s m) and 1/(s rad): where to coverage improves fastest; 0 along
    the axes on which the planner does not go by phi."""
    lines: tuple[str, ...]
    """In words, one fact each; plain text."""


def explain(
    importance: ImportanceField,
    sensing: Sensing,
    states: Mapping[int, DroneState],
    drone: int,
    planner: PlannerName = "coverage",
    count: int = 5,
) -> Explanation:
    """Of ``drone``, which is among ``states``, the newest of every live drone; at most ``count`` places.

    What does not move the ``planner`` is left out: nothing of phi pulls a lawnmower.
    """
    team = sorted(states)
    poses = np.array([states[number].pose for number in team])
    cells = attraction(importance.field, importance.phi, sensing, poses, team.index(drone))
    cells = replace(cells, gradients=np.where(FREE_AXES[planner], cells.gradients, 0.0))
    sums = sensing.decay_per_s * cells.gradients.sum(axis=0)
    pulls, opposed = _pulls(cells, importance.phi, sensing.decay_per_s, count)
    state = states[drone]
    x, y, z, yaw, pitch = sums.tolist()
    return Explanation(
        drone=drone,
        tick=state.tick,
        pulls=pulls,
        opposed=opposed,
        xi1=(x, y, z, yaw, pitch),
        lines=(
            _motion(state),
            *_planner_in_words(state, planner),
            *(_attraction_in_words(state, pulls, opposed) if any(FREE_AXES[planner]) else ()),
            *_control_in_words(state),
        ),
    )


def _pulls(
    cells: Attraction, phi: NDArray[np.float32], decay_per_s: float, count: int
) -> tuple[tuple[Pull, ...], float]:
    """The strongest places, and how much of all pull along the sum is cancelled."""
    vectors = decay_per_s * cells.gradients[:, :3]
    total = vectors.sum(axis=0)
    size = float(np.linalg.norm(total))
    if size == 0:
        return (), 0.0
    along = vectors @ (total / size)
    forward = float(along[along > 0].sum())
    means = phi[cells.rows].mean(axis=1)
    pulls = [
        Pull(
            position=_vector(along[place] @ cells.places[place] / along[place].sum()),
            importance=float(along[place] @ means[place] / along[place].sum()),
            vector=_vector(vectors[place].sum(axis=0)),
            share=float(along[place].sum()) / forward,
        )
        for place in _places(cells.places, along)
    ]
    pulls.sort(key=lambda pull: pull.share, reverse=True)
    return tuple(pulls[:count]), 1 - size / forward


def _places(positions: Floats, along: Floats) -> Iterator[NDArray[np.int64]]:
    """Indices of the cells of each place: the strongest cell that is left, with what lies around it."""
    left = along > 0
    while left.any():
        strongest = positions[np.where(left, along, 0.0).argmax()]
        near = left & (np.linalg.norm(positions - strongest, axis=1) <= PLACE_RADIUS_M)
        yield np.flatnonzero(near)
        left &= ~near


def _vector(values: Floats) -> Vector3:
    x, y, z = values.tolist()
    return x, y, z


def _motion(state: DroneState) -> str:
    speed = math.hypot(*state.velocity[:3])
    yaw_rate, pitch_rate = state.velocity[3:]
    parts = []
    if speed >= STILL_MPS:
        x, y, z = (component / speed for component in state.velocity[:3])
        parts.append(f"moves {speed:.2f} m/s along ({x:+.2f}, {y:+.2f}, {z:+.2f})")
    if abs(yaw_rate) >= STILL_RADPS:
        parts.append(f"turns {'left' if yaw_rate > 0 else 'right'} {abs(yaw_rate):.2f} rad/s")
    if abs(pitch_rate) >= STILL_RADPS:
        parts.append(f"tilts its camera {'down' if pitch_rate > 0 else 'up'} {abs(pitch_rate):.2f} rad/s")
    return f"{state.mode}: " + (", ".join(parts) if parts else "stands still")


def _planner_in_words(state: DroneState, planner: PlannerName) -> Iterator[str]:
    if planner != "coverage":
        yield f"planner {planner.replace('_', ' ')}: {OTHERS[planner]}"
        if state.mode not in STEERED and not any(FREE_AXES[planner]):
            yield f"{state.mode}: its planner does not steer it now"


def _attraction_in_words(state: DroneState, pulls: tuple[Pull, ...], opposed: float) -> Iterator[str]:
    if state.mode not in STEERED:
        yield f"{state.mode}: importance does not steer it now, it would be pulled so:"
    if not pulls:
        yield "nothing in its reach is of importance"
    for pull in pulls:
        x, y, z = pull.position
        distance = math.dist(pull.position, state.pose[:3])
        yield (
            f"{pull.share:.0%} of the pull: ({x:.1f}, {y:.1f}, {z:.1f}), {distance:.1f} m away, "
            f"importance {pull.importance:.2f}"
        )
    if pulls:
        yield f"{opposed:.0%} of it is cancelled by what pulls the other way"


def _control_in_words(state: DroneState) -> Iterator[str]:
    control = state.control
    if control is None or control.outcome == "none":
        yield "has not decided anything yet"
        return
    if control.outcome != "solved":
        yield f"solver: {control.outcome.replace('_', ' ')}, so it brakes"
    yield f"limits: {all_in_words(control.active) or 'none in the way'}"
    yield from _figures(control)


def _figures(control: Control) -> Iterator[str]:
    margins = {
        f"separation {control.separation_margin_m2:.2f} m²": control.separation_margin_m2,
        f"region {control.region_margin_m:.2f} m": control.region_margin_m,
        f"obstacles {control.obstacle_margin_m:.2f} m": control.obstacle_margin_m,
        f"gimbal {control.pitch_margin_rad2:.3f} rad²": control.pitch_margin_rad2,
    }
    yield "margins: " + ", ".join(text for text, value in margins.items() if margin(value) is not None)
    if control.slack < 0:
        yield f"slack {control.slack:.3g}: its share cannot be covered as fast as wished"
