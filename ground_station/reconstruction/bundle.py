"""Bundle adjustment: camera poses such that what several images show lies in one place, and near where they were told.

A landmark is a pixel of one view, its anchor, with an inverse depth (Civera et al., "Inverse depth parametrization for
monocular SLAM", 2008); so it has one unknown, and eliminating it (the Schur complement) takes no matrix inversion.
Every pose is drawn to where it was measured, in proportion to the measurement's variance. Poses that are held fixed
carry on what earlier windows found.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from protocol.geometry import Floats, rotation_vector, turn_matrix

POSE: Final = 6
"""Unknowns of a pose: a shift in m and a turn in rad, both in the world frame."""
SIGHTINGS_MAX: Final = 16
"""Of one landmark, beside its anchor."""
SIGHTING_PX: Final = 1.5
"""Standard deviation that a sighting counts as: more than it has, for they err together (docs/adr/0016) ..."""
DOUBTED_PX: Final = 2.0
"""... and the error at which its weight has fallen to a quarter (Geman and McClure)."""
DAMPING: Final = 1e-3
"""Share by which a landmark's own curvature is raised: one seen along its ray would else run away."""
NONE: Final = -1


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """Those of one adjustment. ``count`` of each row's sightings are used."""

    anchor: NDArray[np.int64]
    """(N,) view."""
    ray: Floats
    """(N, 3) camera frame of the anchor, z = 1."""
    inverse_depth: Floats
    """(N,) 1/m; `adjust` changes it."""
    count: NDArray[np.int64]
    """(N,)"""
    view: NDArray[np.int16]
    """(N, SIGHTINGS_MAX) where it was seen again ..."""
    place: Floats
    """(N, SIGHTINGS_MAX, 2) ... at x / z and y / z of that view's camera frame."""


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """Where the views were measured to be."""

    position: Floats
    """(V, 3)"""
    rotation: Floats
    """(V, 3, 3)"""
    sigma_m: float
    """Standard deviation of each axis."""
    sigma_rad: float


def adjust(
    position: Floats,
    rotation: Floats,
    focal: Floats,
    free: NDArray[np.int64],
    prior: Prior,
    landmarks: Landmarks,
    doubted_px: float = DOUBTED_PX,
) -> None:
    """One Gauss-Newton step, in place, of the ``free`` views' poses and of the landmarks.

    ``position`` (V, 3), ``rotation`` (V, 3, 3) camera to world; ``focal`` (V,) pixels.
    """
    column = np.full(len(position), NONE, np.int64)
    column[free] = np.arange(len(free))
    size = POSE * len(free)
    curvature, slope = np.zeros((size, size)), np.zeros(size)
    for number, view in enumerate(free):
        block = slice(POSE * number, POSE * number + 3), slice(POSE * number + 3, POSE * number + POSE)
        away = rotation_vector(prior.rotation[view] @ rotation[view].T)
        for part, gap, sigma in (
            (block[0], prior.position[view] - position[view], prior.sigma_m),
            (block[1], away, prior.sigma_rad),
        ):
            curvature[part, part] = np.eye(3) / sigma**2
            slope[part] = gap / sigma**2
    couplings = np.zeros((len(landmarks.anchor), SIGHTINGS_MAX + 1, POSE))
    own = np.zeros((len(landmarks.anchor), 2))
    _accumulate(
        position, rotation, focal, column, landmarks.anchor, landmarks.ray, landmarks.inverse_depth, landmarks.count,
        landmarks.view, landmarks.place, doubted_px, curvature, slope, couplings, own,
    )  # fmt: skip
    step = _solve(curvature, slope)
    _move_landmarks(
        column, landmarks.anchor, landmarks.count, landmarks.view, couplings, own, step, landmarks.inverse_depth
    )
    for number, view in enumerate(free):
        move = step[POSE * number : POSE * (number + 1)]
        position[view] += move[:3]
        rotation[view] = turn_matrix(move[3:]) @ rotation[view]


def sighting_errors(position: Floats, rotation: Floats, focal: Floats, landmarks: Landmarks) -> Floats:
    """(N, SIGHTINGS_MAX) px between where each sighting is and where it should be; 0 for those that there are not."""
    errors = np.zeros(landmarks.view.shape)
    _measure(
        position, rotation, focal, landmarks.anchor, landmarks.ray, landmarks.inverse_depth, landmarks.count,
        landmarks.view, landmarks.place, errors,
    )  # fmt: skip
    return errors


@njit(cache=True, nogil=True, error_model="numpy")
def _measure(
    position: Floats,
    rotation: Floats,
    focal: Floats,
    anchor: NDArray[np.int64],
    ray: Floats,
    inverse_depth: Floats,
    count: NDArray[np.int64],
    view: NDArray[np.int16],
    place: Floats,
    errors: Floats,
) -> None:
    gap, local = np.empty(3), np.empty(3)
    for number in range(anchor.size):
        first = anchor[number]
        for seen in range(count[number]):
            here = view[number, seen]
            across, down = _sighting_error(
                position[first], rotation[first], ray[number], inverse_depth[number],
                position[here], rotation[here], place[number, seen], gap, local,
            )  # fmt: skip
            errors[number, seen] = np.hypot(across, down) * focal[here]


@njit(cache=True, nogil=True, error_model="numpy")
def _sighting_error(
    anchor_position: Floats,
    anchor_rotation: Floats,
    ray: Floats,
    inverse_depth: float,
    position: Floats,
    rotation: Floats,
    place: Floats,
    gap: Floats,
    local: Floats,
) -> tuple[float, float]:
    """Expected less seen ``place`` at x / z, y / z of a camera; huge if behind it.

    Fills ``gap`` (3,), from the camera to the point times the inverse depth, world, and ``local``, camera frame.
    """
    for axis in range(3):
        gap[axis] = inverse_depth * (anchor_position[axis] - position[axis])
        for entry in range(3):
            gap[axis] += anchor_rotation[axis, entry] * ray[entry]
    for axis in range(3):
        local[axis] = 0.0
        for entry in range(3):
            local[axis] += rotation[entry, axis] * gap[entry]
    if local[2] < 1e-3:
        return 1e3, 1e3
    return local[0] / local[2] - place[0], local[1] / local[2] - place[1]


@njit(cache=True, nogil=True, error_model="numpy")
def _accumulate(
    position: Floats,
    rotation: Floats,
    focal: Floats,
    column: NDArray[np.int64],
    anchor: NDArray[np.int64],
    ray: Floats,
    inverse_depth: Floats,
    count: NDArray[np.int64],
    view: NDArray[np.int16],
    place: Floats,
    doubted_px: float,
    curvature: Floats,
    slope: Floats,
    couplings: Floats,
    own: Floats,
) -> None:
    """The normal equations of the poses, with the landmarks eliminated.

    ``couplings`` (N, 1 + SIGHTINGS_MAX, 6): each landmark's with its anchor and its sightings; ``own`` (N, 2): its
    curvature and slope.
    """
    gap, local, arm = np.empty(3), np.empty(3), np.empty(3)
    to_here, to_anchor = np.empty((2, POSE)), np.empty((2, POSE))
    by_local, by_world, error = np.empty((2, 3)), np.empty((2, 3)), np.empty(2)
    for number in range(anchor.size):
        first = anchor[number]
        for axis in range(3):
            arm[axis] = 0.0
            for entry in range(3):
                arm[axis] += rotation[first, axis, entry] * ray[number, entry]
        for seen in range(count[number]):
            here = view[number, seen]
            error[0], error[1] = _sighting_error(
                position[first], rotation[first], ray[number], inverse_depth[number],
                position[here], rotation[here], place[number, seen], gap, local,
            )  # fmt: skip
            if error[0] > 100:
                continue
            squared = (error[0] ** 2 + error[1] ** 2) * focal[here] ** 2
            trust = (1 / (1 + squared / doubted_px**2)) ** 2 * (focal[here] / SIGHTING_PX) ** 2
            by_local[0, 0], by_local[0, 1], by_local[0, 2] = 1 / local[2], 0.0, -local[0] / local[2] ** 2
            by_local[1, 0], by_local[1, 1], by_local[1, 2] = 0.0, 1 / local[2], -local[1] / local[2] ** 2
            for line in range(2):
                for axis in range(3):
                    by_world[line, axis] = 0.0
                    for entry in range(3):
                        by_world[line, axis] += by_local[line, entry] * rotation[here, axis, entry]
                w = by_world[line]
                for axis in range(3):
                    to_anchor[line, axis] = inverse_depth[number] * w[axis]
                    to_here[line, axis] = -to_anchor[line, axis]
                # w . (turn x v) = turn . (v x w)
                to_anchor[line, 3] = arm[1] * w[2] - arm[2] * w[1]
                to_anchor[line, 4] = arm[2] * w[0] - arm[0] * w[2]
                to_anchor[line, 5] = arm[0] * w[1] - arm[1] * w[0]
                to_here[line, 3] = gap[2] * w[1] - gap[1] * w[2]
                to_here[line, 4] = gap[0] * w[2] - gap[2] * w[0]
                to_here[line, 5] = gap[1] * w[0] - gap[0] * w[1]
                deeper = 0.0
                for axis in range(3):
                    deeper += w[axis] * (position[first, axis] - position[here, axis])
                own[number, 0] += trust * deeper * deeper
                own[number, 1] -= trust * deeper * error[line]
                for entry in range(POSE):
                    couplings[number, 0, entry] += trust * deeper * to_anchor[line, entry]
                    couplings[number, seen + 1, entry] += trust * deeper * to_here[line, entry]
            _add(curvature, slope, column[first], column[first], to_anchor, to_anchor, error, trust, True)
            _add(curvature, slope, column[here], column[here], to_here, to_here, error, trust, True)
            _add(curvature, slope, column[first], column[here], to_anchor, to_here, error, trust, False)
            _add(curvature, slope, column[here], column[first], to_here, to_anchor, error, trust, False)
        own[number, 0] = own[number, 0] * (1 + DAMPING) + 1e-6
        for one in range(count[number] + 1):
            row = column[first] if one == 0 else column[view[number, one - 1]]
            if row < 0:
                continue
            for a in range(POSE):
                share = couplings[number, one, a] / own[number, 0]
                slope[POSE * row + a] -= share * own[number, 1]
                for other in range(count[number] + 1):
                    line = column[first] if other == 0 else column[view[number, other - 1]]
                    if line < 0:
                        continue
                    for b in range(POSE):
                        curvature[POSE * row + a, POSE * line + b] -= share * couplings[number, other, b]


@njit(cache=True, nogil=True, error_model="numpy")
def _add(
    curvature: Floats,
    slope: Floats,
    row: int,
    line: int,
    left: Floats,
    right: Floats,
    error: Floats,
    trust: float,
    with_slope: bool,
) -> None:
    if row < 0 or line < 0:
        return
    for a in range(POSE):
        for b in range(POSE):
            product = left[0, a] * right[0, b] + left[1, a] * right[1, b]
            curvature[POSE * row + a, POSE * line + b] += trust * product
        if with_slope:
            slope[POSE * row + a] -= trust * (left[0, a] * error[0] + left[1, a] * error[1])


@njit(cache=True, nogil=True, error_model="numpy")
def _solve(curvature: Floats, slope: Floats) -> Floats:
    """By Cholesky's decomposition, in place and in one order: LAPACK's depends on its threads."""
    size = slope.size
    step = slope.copy()
    for a in range(size):
        for b in range(a + 1):
            total = curvature[a, b]
            for k in range(b):
                total -= curvature[a, k] * curvature[b, k]
            curvature[a, b] = np.sqrt(max(total, 1e-9)) if a == b else total / curvature[b, b]
    for a in range(size):
        for k in range(a):
            step[a] -= curvature[a, k] * step[k]
        step[a] /= curvature[a, a]
    for a in range(size - 1, -1, -1):
        for k in range(a + 1, size):
            step[a] -= curvature[k, a] * step[k]
        step[a] /= curvature[a, a]
    return step


@njit(cache=True, nogil=True, error_model="numpy")
def _move_landmarks(
    column: NDArray[np.int64],
    anchor: NDArray[np.int64],
    count: NDArray[np.int64],
    view: NDArray[np.int16],
    couplings: Floats,
    own: Floats,
    step: Floats,
    inverse_depth: Floats,
) -> None:
    for number in range(anchor.size):
        move = own[number, 1]
        for one in range(count[number] + 1):
            row = column[anchor[number]] if one == 0 else column[view[number, one - 1]]
            if row >= 0:
                for a in range(POSE):
                    move -= couplings[number, one, a] * step[POSE * row + a]
        inverse_depth[number] = max(inverse_depth[number] + move / own[number, 0], 1e-3)
