"""The windowed kernel: decay of the whole team, and one drone's own QP terms, in one pass over the field.

h1 of eq. (1) is exp(-E) with ``E = (1 - c1)^2 / 2 s1^2 + (1 - c2)^2 / 2 s2^2 + rho^2 / 2 s3^2``. The first and
the last term depend on a cell's position alone, so a position where they exceed the cut is skipped with all
its directions, and only the box around each drone's view cone is visited: cost does not grow with the field.

Ownership (PAPER.md, error 1): a cell belongs to the drone with the *largest* h1; a tie goes to the lowest row
of ``poses``, which callers order by drone id, so that every replica agrees.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from protocol.geometry import Floats

Singles = NDArray[np.float32]

EXPONENT_LIMIT = 80.0
"""Largest exponent that `_exp_negative` takes: e^-80 is near float32's smallest normal number."""
_LIMIT, _ONE, _ZERO = np.float32(EXPONENT_LIMIT), np.float32(1), np.float32(0)
_LOG2_E = np.float32(math.log2(math.e))
_TWO_TO_MINUS = tuple(
    np.float32(c)
    for c in np.polynomial.Chebyshev.interpolate(lambda x: 2.0**-x, 6, domain=[0, 1])
    .convert(kind=np.polynomial.Polynomial)
    .coef
)
"""Coefficients of 2^-x on [0, 1], exact to float32."""


@njit(cache=True, nogil=True, fastmath=True)
def _exp_negative(x: Singles, bits: NDArray[np.int32], result: Singles) -> None:
    """``result <- exp(-x)`` for 0 <= x <= EXPONENT_LIMIT; written so that the compiler vectorises it.

    exp(-x) = 2^-n 2^-f with n whole and f in [0, 1): 2^-n is made from its bits, 2^-f by a polynomial.
    """
    c0, c1, c2, c3, c4, c5, c6 = _TWO_TO_MINUS
    powers = bits.view(np.float32)
    for j in range(x.size):
        y = x[j] * _LOG2_E
        n = np.int32(y)
        f = y - np.float32(n)
        bits[j] = (np.int32(127) - n) << np.int32(23)
        result[j] = c0 + f * (c1 + f * (c2 + f * (c3 + f * (c4 + f * (c5 + f * c6)))))
    for j in range(x.size):
        result[j] *= powers[j]


@njit(cache=True, nogil=True, fastmath=True)
def _decay_uncontested(
    phi: Singles,
    views: Singles,
    sight: Singles,
    base: float,
    k2: float,
    cut: float,
    rate: float,
    scratch: Singles,
    bits: NDArray[np.int32],
) -> tuple[float, float, float, float, float, float, float]:
    """All directions of one position that a single drone senses; ``phi`` (directions,) decays in place.

    views: (3, directions) Dir(q) by component. sight: (3,) unit line of sight. base: exponent of the position.
    rate: delta_1 dt. scratch: (3, directions). Returns the sums over h phi of 1, h, t c2, t Dir, with
    t = 1 - c2, and how much phi lost.
    """
    x, y, z = views[0], views[1], views[2]
    exponent, h, factor = scratch[0], scratch[1], scratch[2]
    ex, ey, ez = sight[0], sight[1], sight[2]
    base32, k32, cut32, rate32 = np.float32(base), np.float32(k2), np.float32(cut), np.float32(rate)
    for j in range(phi.size):
        t = _ONE + (x[j] * ex + y[j] * ey + z[j] * ez)
        exponent[j] = min(base32 + t * t * k32, _LIMIT)
    _exp_negative(exponent, bits, h)
    sum_h, sum_hh, sum_tc = _ZERO, _ZERO, _ZERO
    tx, ty, tz = _ZERO, _ZERO, _ZERO
    for j in range(phi.size):
        sensed = h[j] if exponent[j] <= cut32 else _ZERO
        t = _ONE + (x[j] * ex + y[j] * ey + z[j] * ez)
        weight = sensed * phi[j]
        weight_t = weight * t
        sum_h += weight
        sum_hh += sensed * weight
        sum_tc += weight_t * (_ONE - t)
        tx += weight_t * x[j]
        ty += weight_t * y[j]
        tz += weight_t * z[j]
        exponent[j] = min(rate32 * sensed, _LIMIT)
    _exp_negative(exponent, bits, factor)
    removed = 0.0
    for j in range(phi.size):
        after = phi[j] * factor[j]
        removed += np.float64(phi[j]) - np.float64(after)
        phi[j] = after
    return sum_h, sum_hh, sum_tc, tx, ty, tz, removed


@njit(cache=True, nogil=True)
def _clip_to_lattice(low: float, high: float, centres: Floats) -> tuple[int, int]:
    """Half-open range of the lattice indices whose centres lie in [low, high]."""
    pitch = centres[1] - centres[0] if centres.size > 1 else 1.0
    first = math.ceil((low - centres[0]) / pitch)
    last = math.floor((high - centres[0]) / pitch)
    return max(first, 0), min(last + 1, centres.size)


@njit(cache=True, nogil=True)
def _describe(
    pose: Floats, s1: float, s3: float, distance: float, cut: float, xs: Floats, ys: Floats, zs: Floats
) -> tuple[Floats, NDArray[np.int64]]:
    """Optical axis with its yaw and pitch derivatives (9,), and the box of lattice indices (6,) that it can sense.

    The box bounds the cone of half-angle alpha, cos alpha = 1 - s1 sqrt(2 cut), between the radii D -+ s3 sqrt(2 cut).
    """
    axes = np.empty(9)
    yaw, pitch = pose[3], pose[4]
    cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    axes[0], axes[1], axes[2] = cy * cp, sy * cp, -sp
    axes[3], axes[4], axes[5] = -sy * cp, cy * cp, 0.0
    axes[6], axes[7], axes[8] = -cy * sp, -sy * sp, -cp
    reach = math.sqrt(2.0 * cut)
    alpha = math.acos(max(-1.0, 1.0 - s1 * reach))
    near, far = max(0.0, distance - s3 * reach), distance + s3 * reach
    box = np.empty(6, np.int64)
    for k in range(3):
        centres = xs if k == 0 else (ys if k == 1 else zs)
        angle = math.acos(min(1.0, max(-1.0, axes[k])))
        largest = math.cos(max(0.0, angle - alpha))
        smallest = -math.cos(max(0.0, math.pi - angle - alpha))
        high = pose[k] + largest * (far if largest > 0 else near)
        low = pose[k] + smallest * (far if smallest < 0 else near)
        box[2 * k], box[2 * k + 1] = _clip_to_lattice(low, high, centres)
    return axes, box


@njit(cache=True, nogil=True)
def decay_and_terms(
    phi: NDArray[np.float32],
    xs: Floats,
    ys: Floats,
    zs: Floats,
    directions: Floats,
    poses: Floats,
    own: int,
    sigmas: tuple[float, float, float],
    distance: float,
    cut: float,
    decay: float,
    dt: float,
) -> tuple[Floats, float, float, float]:
    """Advance ``phi`` in place by one step of eq. (2), poses held, and return drone ``own``'s sums before it.

    phi: (positions, directions) float32. poses: (drones, 5), ordered by id. own: row of ``poses``, or -1.
    sigmas: sigma_1, sigma_2, sigma_3. decay: delta_1 in 1/s. dt: seconds.
    Returns (gradient, first, second, removed): gradient (5,) = sum over own cells of (dh1/dp) phi,
    first = sum h1 phi, second = sum h1^2 phi, removed = how much the sum of all phi fell.
    """
    s1, s2, s3 = sigmas
    k1, k2, k3 = 0.5 / (s1 * s1), 0.5 / (s2 * s2), 0.5 / (s3 * s3)
    drones, rows = poses.shape[0], directions.shape[0]
    axes = np.empty((drones, 9))
    boxes = np.empty((drones, 6), np.int64)
    for i in range(drones):
        axes[i], boxes[i] = _describe(poses[i], s1, s3, distance, cut, xs, ys, zs)

    gradient = np.zeros(5)
    first, second, removed = 0.0, 0.0, 0.0
    # Drones that can sense the position at hand: their row, exponent of position, and unit line of sight.
    who = np.empty(drones, np.int64)
    base = np.empty(drones)
    sight = np.empty((drones, 3))
    views = np.empty((3, rows), np.float32)
    for j in range(rows):
        views[0, j], views[1, j], views[2, j] = directions[j, 0], directions[j, 1], directions[j, 2]
    line = np.empty(3, np.float32)
    scratch, bits = np.empty((3, rows), np.float32), np.empty(rows, np.int32)

    for i in range(drones):
        for ix in range(boxes[i, 0], boxes[i, 1]):
            for iy in range(boxes[i, 2], boxes[i, 3]):
                for iz in range(boxes[i, 4], boxes[i, 5]):
                    seen = 0
                    mine_r, mine_c1 = 0.0, 0.0
                    for k in range(drones):
                        inside = (
                            boxes[k, 0] <= ix < boxes[k, 1]
                            and boxes[k, 2] <= iy < boxes[k, 3]
                            and boxes[k, 4] <= iz < boxes[k, 5]
                        )
                        if not inside:
                            continue
                        dx, dy, dz = xs[ix] - poses[k, 0], ys[iy] - poses[k, 1], zs[iz] - poses[k, 2]
                        r = math.sqrt(dx * dx + dy * dy + dz * dz)
                        if r < 1e-9:  # the line of sight has no direction inside the camera
                            continue
                        ex, ey, ez = dx / r, dy / r, dz / r
                        c1 = axes[k, 0] * ex + axes[k, 1] * ey + axes[k, 2] * ez
                        rho = r - distance
                        exponent = (1.0 - c1) * (1.0 - c1) * k1 + rho * rho * k3
                        if exponent > cut:
                            continue
                        who[seen], base[seen] = k, exponent
                        sight[seen, 0], sight[seen, 1], sight[seen, 2] = ex, ey, ez
                        seen += 1
                        if k == own:
                            mine_r, mine_c1 = r, c1
                    if seen == 0 or who[0] != i:  # each position once: with the lowest row that senses it
                        continue

                    row = (ix * ys.size + iy) * zs.size + iz
                    sum_h, sum_hh, sum_tc = 0.0, 0.0, 0.0
                    tx, ty, tz = 0.0, 0.0, 0.0
                    if seen == 1:
                        line[0], line[1], line[2] = sight[0, 0], sight[0, 1], sight[0, 2]
                        sum_h, sum_hh, sum_tc, tx, ty, tz, lost = _decay_uncontested(
                            phi[row], views, line, base[0], k2, cut, decay * dt, scratch, bits
                        )
                        removed += lost
                    else:
                        for j in range(rows):
                            best, winner, best_t = cut, -1, 0.0
                            for s in range(seen):
                                t = 1.0 + (
                                    directions[j, 0] * sight[s, 0]
                                    + directions[j, 1] * sight[s, 1]
                                    + directions[j, 2] * sight[s, 2]
                                )
                                exponent = base[s] + t * t * k2
                                if exponent < best or (winner < 0 and exponent == best):
                                    best, winner, best_t = exponent, s, t
                            if winner < 0:
                                continue
                            h = math.exp(-best)
                            value = phi[row, j]
                            if who[winner] == own:
                                weight = h * value
                                sum_h += weight
                                sum_hh += h * weight
                                sum_tc += weight * best_t * (1.0 - best_t)
                                tx += weight * best_t * directions[j, 0]
                                ty += weight * best_t * directions[j, 1]
                                tz += weight * best_t * directions[j, 2]
                            after = np.float32(value * math.exp(-decay * dt * h))
                            phi[row, j] = after
                            removed += np.float64(value) - np.float64(after)
                    if mine_r == 0.0 or sum_h == 0.0:
                        continue

                    # The chain rule of E, with the parts that are equal for all directions taken out of the sum.
                    first += sum_h
                    second += sum_hh
                    dx, dy, dz = xs[ix] - poses[own, 0], ys[iy] - poses[own, 1], zs[iz] - poses[own, 2]
                    ex, ey, ez = dx / mine_r, dy / mine_r, dz / mine_r
                    along = sum_h * 2.0 * k1 * (1.0 - mine_c1)
                    range_part = sum_h * 2.0 * k3 * (mine_r - distance)
                    view = 2.0 * k2 / mine_r
                    radial = along * mine_c1 / mine_r + view * sum_tc + range_part
                    gradient[0] += -along * axes[own, 0] / mine_r + view * tx + radial * ex
                    gradient[1] += -along * axes[own, 1] / mine_r + view * ty + radial * ey
                    gradient[2] += -along * axes[own, 2] / mine_r + view * tz + radial * ez
                    gradient[3] += along * (axes[own, 3] * ex + axes[own, 4] * ey + axes[own, 5] * ez)
                    gradient[4] += along * (axes[own, 6] * ex + axes[own, 7] * ey + axes[own, 8] * ez)
    return gradient, first, second, removed


@njit(cache=True, nogil=True)
def owned_shares(
    xs: Floats,
    ys: Floats,
    zs: Floats,
    directions: Floats,
    poses: Floats,
    sigmas: tuple[float, float, float],
    distance: float,
    stride: int,
) -> Floats:
    """|V_i| / m of every drone, (drones,), from every ``stride``-th cell of each lattice axis and direction.

    No cut here: every cell has an owner, however badly it is sensed. ``stride`` 1 is exact.
    """
    s1, s2, s3 = sigmas
    k1, k2, k3 = 0.5 / (s1 * s1), 0.5 / (s2 * s2), 0.5 / (s3 * s3)
    drones = poses.shape[0]
    counts = np.zeros(drones)
    base = np.empty(drones)
    sight = np.empty((drones, 3))
    for ix in range(stride // 2, xs.size, stride):
        for iy in range(stride // 2, ys.size, stride):
            for iz in range(min(stride // 2, zs.size - 1), zs.size, stride):
                for k in range(drones):
                    dx, dy, dz = xs[ix] - poses[k, 0], ys[iy] - poses[k, 1], zs[iz] - poses[k, 2]
                    r = max(math.sqrt(dx * dx + dy * dy + dz * dz), 1e-9)
                    sight[k, 0], sight[k, 1], sight[k, 2] = dx / r, dy / r, dz / r
                    ax = math.cos(poses[k, 3]) * math.cos(poses[k, 4])
                    ay = math.sin(poses[k, 3]) * math.cos(poses[k, 4])
                    c1 = ax * sight[k, 0] + ay * sight[k, 1] - math.sin(poses[k, 4]) * sight[k, 2]
                    base[k] = (1.0 - c1) * (1.0 - c1) * k1 + (r - distance) * (r - distance) * k3
                for j in range(min(stride // 2, directions.shape[0] - 1), directions.shape[0], stride):
                    best, winner = np.inf, 0
                    for k in range(drones):
                        c2 = -(
                            directions[j, 0] * sight[k, 0]
                            + directions[j, 1] * sight[k, 1]
                            + directions[j, 2] * sight[k, 2]
                        )
                        exponent = base[k] + (1.0 - c2) * (1.0 - c2) * k2
                        if exponent < best:
                            best, winner = exponent, k
                    counts[winner] += 1.0
    return counts / counts.sum()
