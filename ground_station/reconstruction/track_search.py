"""Looks for the landmarks of earlier views in a new one: which of them should show, and where they do."""

from __future__ import annotations

from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ground_station.reconstruction.patch_search import RADIUS, SIDE, draw_patch, project, search
from protocol.geometry import Floats

COSINE_MIN: Final = float(np.cos(np.radians(35.0)))
"""Of the angle between two views of a landmark: from further aside it looks another."""
DISTANCE_MAX: Final = 1.6
"""Largest ratio of the distances from which a landmark is seen."""
COARSE: Final = 2
"""Pixels of an image to one of its half-size copy, across and down."""
DEPTH_STEPS: Final = 48
"""Inverse depths tried when a depth is read off the line on which a landmark was found."""


@njit(cache=True, nogil=True, error_model="numpy")
def relate(
    position: Floats, rotation: Floats, other_position: Floats, other_rotation: Floats, turn: Floats, shift: Floats
) -> None:
    """``turn`` (3, 3) and ``shift`` (3,) from the first camera's frame to the other's."""
    for row in range(3):
        shift[row] = 0.0
        for axis in range(3):
            shift[row] += other_rotation[axis, row] * (position[axis] - other_position[axis])
        for column in range(3):
            turn[row, column] = 0.0
            for axis in range(3):
                turn[row, column] += other_rotation[axis, row] * rotation[axis, column]


@njit(cache=True, nogil=True, error_model="numpy")
def choose(
    views: NDArray[np.int64],
    position: Floats,
    rotation: Floats,
    camera: Floats,
    corners: Floats,
    corner_count: NDArray[np.int64],
    inverse_depth: Floats,
    worth: NDArray[np.int64],
    here: int,
    size: tuple[int, int],
    cell: int,
    taken: NDArray[np.bool_],
) -> NDArray[np.int64]:
    """(M, 2) view and number of the landmarks of ``views`` that view ``here`` should show, at most one in a cell.

    ``worth`` (V, P): the highest is chosen, none of worth 0 or less. ``taken`` (rows, columns) cells get none.
    ``size`` is height and width of the image.
    """
    height, width = size
    rows, columns = taken.shape
    best = np.zeros((rows, columns))
    chosen = np.full((rows, columns, 2), -1, np.int64)
    turn, shift, ray = np.empty((3, 3)), np.empty(3), np.ones(3)
    for view in views:
        relate(position[view], rotation[view], position[here], rotation[here], turn, shift)
        if turn[2, 2] < COSINE_MIN:
            continue
        for number in range(corner_count[view]):
            if worth[view, number] <= 0:
                continue
            ray[0] = (corners[view, number, 0] - camera[view, 2]) / camera[view, 0]
            ray[1] = (corners[view, number, 1] - camera[view, 3]) / camera[view, 1]
            w = inverse_depth[view, number]
            u, v, z = project(ray, w, turn, shift, camera[here])
            if z < 1 / DISTANCE_MAX or z > DISTANCE_MAX:
                continue
            if u < RADIUS or v < RADIUS or u > width - 1 - RADIUS or v > height - 1 - RADIUS:
                continue
            row, column = int(v) // cell, int(u) // cell
            if taken[row, column]:
                continue
            cosine = _cosine(ray, w, turn, shift)
            if cosine < COSINE_MIN:
                continue
            value = worth[view, number] + cosine
            if value > best[row, column]:
                best[row, column] = value
                chosen[row, column, 0], chosen[row, column, 1] = view, number
    flat = chosen.reshape(rows * columns, 2)
    return flat[flat[:, 0] >= 0]


@njit(cache=True, nogil=True, error_model="numpy")
def _cosine(ray: Floats, inverse_depth: float, turn: Floats, shift: Floats) -> float:
    """Of the angle at the landmark between the two cameras."""
    product, own, other = 0.0, 0.0, 0.0
    for row in range(3):
        turned = turn[row, 0] * ray[0] + turn[row, 1] * ray[1] + turn[row, 2] * ray[2]
        seen = turned + inverse_depth * shift[row]
        product, own, other = product + turned * seen, own + turned * turned, other + seen * seen
    return float(product / np.sqrt(own * other))


@njit(cache=True, nogil=True, error_model="numpy")
def find(
    chosen: NDArray[np.int64],
    fine: NDArray[np.uint8],
    coarse: NDArray[np.uint8],
    position: Floats,
    rotation: Floats,
    camera: Floats,
    corners: Floats,
    inverse_depth: Floats,
    here: int,
    reach: float,
    nearest: float,
    farthest: float,
) -> Floats:
    """(M, 4) column, row, correlation and inverse depth of each of ``chosen`` (M, 2) in view ``here``; 0 if not found.

    ``fine`` (V, H, W) and ``coarse`` (V, H / 2, W / 2) are all views' images. A landmark is looked for within ``reach``
    pixels of where its depth puts it, or, if ``farthest`` is not 0, of the line of all depths up to that; its inverse
    depth is then read off there. From 4 pixels on, the half-size image is searched first.
    """
    found = np.zeros((len(chosen), 4))
    turn, shift, ray = np.empty((3, 3)), np.empty(3), np.ones(3)
    patch = np.empty((SIDE, SIDE), np.float32)
    rough = reach >= 4.0
    half = np.empty(4)
    half_own = np.empty(4)
    for number in range(len(chosen)):
        view, corner = chosen[number]
        relate(position[view], rotation[view], position[here], rotation[here], turn, shift)
        ray[0] = (corners[view, corner, 0] - camera[view, 2]) / camera[view, 0]
        ray[1] = (corners[view, corner, 1] - camera[view, 3]) / camera[view, 1]
        w = inverse_depth[view, corner]
        low, high = (1 / farthest, 1 / nearest) if farthest > 0 else (w, w)
        u0, v0, z0 = project(ray, low, turn, shift, camera[here])
        u1, v1, z1 = project(ray, high, turn, shift, camera[here])
        if z0 < 0 or z1 < 0:
            continue
        line, radius = (u0, v0, u1, v1), reach
        if rough:
            for axis in range(2):
                half[axis], half_own[axis] = camera[here, axis] / COARSE, camera[view, axis] / COARSE
                half[axis + 2] = (camera[here, axis + 2] + 0.5) / COARSE - 0.5
                half_own[axis + 2] = (camera[view, axis + 2] + 0.5) / COARSE - 0.5
            place = (corners[view, corner] + 0.5) / COARSE - 0.5
            if not draw_patch(coarse[view], place, half_own, w, turn, shift, half, patch):
                continue
            shrunk = (
                (u0 + 0.5) / COARSE - 0.5,
                (v0 + 0.5) / COARSE - 0.5,
                (u1 + 0.5) / COARSE - 0.5,
                (v1 + 0.5) / COARSE - 0.5,
            )
            u, v, like = search(coarse[here], patch, shrunk, reach / COARSE)
            if like <= 0:
                continue
            u, v = (u + 0.5) * COARSE - 0.5, (v + 0.5) * COARSE - 0.5
            line, radius = (u, v, u, v), 2.5
        if not draw_patch(fine[view], corners[view, corner], camera[view], w, turn, shift, camera[here], patch):
            continue
        u, v, like = search(fine[here], patch, line, radius)
        if like <= 0:
            continue
        if farthest > 0:
            w = _read_depth(ray, turn, shift, camera[here], u, v, low, high)
        found[number, 0], found[number, 1], found[number, 2], found[number, 3] = u, v, like, w
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def _read_depth(
    ray: Floats, turn: Floats, shift: Floats, focal: Floats, u: float, v: float, low: float, high: float
) -> float:
    """The inverse depth that puts the landmark closest to (u, v)."""
    best, nearest = low, 1e18
    for step in range(DEPTH_STEPS):
        w = low + (high - low) * step / (DEPTH_STEPS - 1)
        x, y, _ = project(ray, w, turn, shift, focal)
        away = (x - u) ** 2 + (y - v) ** 2
        if away < nearest:
            best, nearest = w, away
    return best
