"""The windowed kernel: decay of the whole team, and one drone's own QP terms, in one pass over the field.

h1 of eq. (1) is exp(-E) with ``E = (1 - c1)^2 / 2 s1^2 + (1 - c2)^2 / 2 s2^2 + rho^2 / 2 s3^2``. The first and
the last term depend on a cell's position alone, so a position where they exceed the cut is skipped with all
its directions, and only the box around each drone's view cone is visited: cost does not grow with the field.

Ownership (ARCHITECTURE.md, departure 1): a cell belongs to the drone with the *largest* h1; a tie goes to the lowest
row of ``poses``, which callers order by drone id, so that every replica agrees.
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
def _exp_negative(x: Singles, bits: NDArray[np.int32], powers: Singles, result: Singles) -> None:
    """``result <- exp(-x)`` for 0 <= x <= EXPONENT_LIMIT; written so that the compiler vectorises it.

    exp(-x) = 2^-n 2^-f with n whole and f in [0, 1): 2^-n is made from its bits, 2^-f by a polynomial. ``powers``
    is the memory of ``bits`` seen as float32.
    """
    c0, c1, c2, c3, c4, c5, c6 = _TWO_TO_MINUS
    for j in range(x.size):
        y = x[j] * _LOG2_E
        n = np.int32(y)
        f = y - np.float32(n)
        bits[j] = (np.int32(127) - n) << np.int32(23)
        result[j] = c0 + f * (c1 + f * (c2 + f * (c3 + f * (c4 + f * (c5 + f * c6)))))
    for j in range(x.size):
        result[j] *= powers[j]


LANES = 8
"""Direction tables are padded to a multiple of this, so that vectorised loops have no rest."""


@njit(cache=True, nogil=True, fastmath=True)
def _decay_position(
    phi: Singles,
    row: int,
    x: Singles,
    y: Singles,
    z: Singles,
    seen: int,
    sight: Floats,
    base: Floats,
    mine: int,
    k2: float,
    cut: float,
    rate: float,
    exponent: Singles,
    owner: NDArray[np.int32],
    h: Singles,
    values: Singles,
    bits: NDArray[np.int32],
    powers: Singles,
) -> tuple[float, float, float, float, float, float, float]:
    """All directions of one position that ``seen`` drones sense; row ``row`` of ``phi`` decays in place.

    x, y, z: (padded directions,) components of Dir(q), zero in the padding. sight: (seen, 3) unit lines of sight.
    base: (seen,) exponents of the position. mine: which of them is the drone whose sums are wanted, or -1.
    rate: delta_1 dt. Scratch, all (padded directions,) and made once, because making a view costs as much as the
    arithmetic: exponent, owner, h, values (zero in the padding), bits and powers (`_exp_negative`).
    Returns the sums over own h phi of 1, h, t c2, t Dir, with t = 1 - c2, and how much phi lost.
    """
    k32, cut32, rate32 = np.float32(k2), np.float32(cut), np.float32(rate)
    for j in range(phi.shape[1]):
        values[j] = phi[row, j]
    for j in range(exponent.size):
        exponent[j] = _LIMIT
        owner[j] = -1
    for s in range(seen):
        ex, ey, ez, base32 = (
            np.float32(sight[s, 0]),
            np.float32(sight[s, 1]),
            np.float32(sight[s, 2]),
            np.float32(base[s]),
        )
        for j in range(exponent.size):
            t = _ONE + (x[j] * ex + y[j] * ey + z[j] * ez)
            candidate = base32 + t * t * k32
            better = candidate < exponent[j]
            exponent[j] = candidate if better else exponent[j]
            owner[j] = np.int32(s) if better else owner[j]
    _exp_negative(exponent, bits, powers, h)
    for j in range(exponent.size):
        h[j] = h[j] if exponent[j] <= cut32 else _ZERO
    sum_h, sum_hh, sum_tc = _ZERO, _ZERO, _ZERO
    tx, ty, tz = _ZERO, _ZERO, _ZERO
    if mine >= 0:
        ex, ey, ez = np.float32(sight[mine, 0]), np.float32(sight[mine, 1]), np.float32(sight[mine, 2])
        for j in range(exponent.size):
            t = _ONE + (x[j] * ex + y[j] * ey + z[j] * ez)
            weight = h[j] * values[j] if owner[j] == mine else _ZERO
            weight_t = weight * t
            sum_h += weight
            sum_hh += h[j] * weight
            sum_tc += weight_t * (_ONE - t)
            tx += weight_t * x[j]
            ty += weight_t * y[j]
            tz += weight_t * z[j]
    removed = 0.0
    if rate32 == _ZERO:
        return float(sum_h), float(sum_hh), float(sum_tc), float(tx), float(ty), float(tz), removed
    for j in range(exponent.size):
        exponent[j] = min(rate32 * h[j], _LIMIT)
    _exp_negative(exponent, bits, powers, h)
    for j in range(phi.shape[1]):
        after = values[j] * h[j]
        removed += np.float64(values[j]) - np.float64(after)
        phi[row, j] = after
    return float(sum_h), float(sum_hh), float(sum_tc), float(tx), float(ty), float(tz), removed


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
    start: int,
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

    phi: (positions, directions) float32, of the lattice's positions from ``start`` on: the others are left out.
    poses: (drones, 5), ordered by id. own: row of ``poses``, or -1.
    sigmas: sigma_1, sigma_2, sigma_3. decay: delta_1 in 1/s. dt: seconds.
    Returns (gradient, first, second, removed): gradient (5,) = sum over own cells of (dh1/dp) phi,
    first = sum h1 phi, second = sum h1^2 phi, removed = how much the sum of all phi fell.
    With ``dt`` = 0 phi is only read, and only what drone ``own`` senses.
    """
    s1, s2, s3 = sigmas
    k1, k2, k3 = 0.5 / (s1 * s1), 0.5 / (s2 * s2), 0.5 / (s3 * s3)
    drones, rows = poses.shape[0], directions.shape[0]
    axes = np.empty((drones, 9))
    boxes = np.empty((drones, 6), np.int64)
    for i in range(drones):
        axes[i], boxes[i] = _describe(poses[i], s1, s3, distance, cut, xs, ys, zs)

    reach = math.sqrt(2.0 * cut)
    nearest = max(1e-9, distance - s3 * reach) ** 2
    farthest = (distance + s3 * reach) ** 2
    narrow = s1 * reach < 1.0  # the view cone is narrower than a half space

    gradient = np.zeros(5)
    first, second, removed = 0.0, 0.0, 0.0
    # Of the drones that can sense the position at hand: exponent of position, and unit line of sight.
    base = np.empty(drones)
    sight = np.empty((drones, 3))
    padded = (rows + LANES - 1) // LANES * LANES
    views_x, views_y, views_z = np.zeros(padded, np.float32), np.zeros(padded, np.float32), np.zeros(padded, np.float32)
    for j in range(rows):
        views_x[j], views_y[j], views_z[j] = directions[j, 0], directions[j, 1], directions[j, 2]
    exponents, senses, values = np.empty(padded, np.float32), np.empty(padded, np.float32), np.zeros(padded, np.float32)
    bits, owners = np.empty(padded, np.int32), np.empty(padded, np.int32)
    powers = bits.view(np.float32)

    reads = dt == 0.0
    end, layer = start + phi.shape[0], ys.size * zs.size
    for i in range(drones):
        if reads and i != own:
            continue
        for ix in range(max(boxes[i, 0], start // layer), min(boxes[i, 1], (end - 1) // layer + 1)):
            for iy in range(boxes[i, 2], boxes[i, 3]):
                for iz in range(boxes[i, 4], boxes[i, 5]):
                    row = (ix * ys.size + iy) * zs.size + iz
                    if row < start or row >= end:
                        continue
                    seen = 0
                    mine, mine_r, mine_c1 = -1, 0.0, 0.0
                    for k in range(drones):
                        inside = (
                            boxes[k, 0] <= ix < boxes[k, 1]
                            and boxes[k, 2] <= iy < boxes[k, 3]
                            and boxes[k, 4] <= iz < boxes[k, 5]
                        )
                        if not inside:
                            continue
                        dx, dy, dz = xs[ix] - poses[k, 0], ys[iy] - poses[k, 1], zs[iz] - poses[k, 2]
                        square = dx * dx + dy * dy + dz * dz
                        along_axis = axes[k, 0] * dx + axes[k, 1] * dy + axes[k, 2] * dz
                        # Outside the shell or behind the camera, told without a square root. Inside the camera
                        # itself the line of sight has no direction.
                        if square < nearest or square > farthest or (narrow and along_axis <= 0.0):
                            if k == i:
                                seen = 0
                                break
                            continue
                        r = math.sqrt(square)
                        c1 = along_axis / r
                        rho = r - distance
                        exponent = (1.0 - c1) * (1.0 - c1) * k1 + rho * rho * k3
                        if exponent > cut:
                            if k == i:
                                seen = 0
                                break
                            continue
                        if k < i and not reads:  # visited with drone k's box
                            break
                        base[seen] = exponent
                        sight[seen, 0], sight[seen, 1], sight[seen, 2] = dx / r, dy / r, dz / r
                        seen += 1
                        if k == own:
                            mine, mine_r, mine_c1 = seen - 1, r, c1
                    if seen == 0:  # each position once: with the lowest row that senses it
                        continue

                    sum_h, sum_hh, sum_tc, tx, ty, tz, lost = _decay_position(
                        phi, row - start, views_x, views_y, views_z, seen, sight, base, mine, k2, cut, decay * dt,
                        exponents, owners, senses, values, bits, powers,
                    )  # fmt: skip
                    removed += lost
                    if mine < 0 or sum_h == 0.0:
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


@njit(cache=True, nogil=True, fastmath=True)
def raise_positions(phi: Singles, increments: Singles) -> float:
    """Add ``increments`` (positions,) to all directions of ``phi`` (positions, directions); how much their sum rose."""
    gained = 0.0
    for row in range(phi.shape[0]):
        increment = increments[row]
        if increment == _ZERO:
            continue
        for j in range(phi.shape[1]):
            before = phi[row, j]
            after = before + increment
            gained += np.float64(after) - np.float64(before)
            phi[row, j] = after
    return gained


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
    """|V_i| / m of every drone, (drones,), from all directions at every ``stride``-th position; 1 is exact.

    No cut here: every cell has an owner, however badly it is sensed. A stride that shares no factor with the
    lattice's side lengths takes its samples from all of its layers alike.
    """
    s1, s2, s3 = sigmas
    k1, k2, k3 = 0.5 / (s1 * s1), 0.5 / (s2 * s2), 0.5 / (s3 * s3)
    drones = poses.shape[0]
    counts = np.zeros(drones)
    base = np.empty(drones)
    sight = np.empty((drones, 3))
    axes = np.empty((drones, 3))
    for k in range(drones):
        axes[k, 0] = math.cos(poses[k, 3]) * math.cos(poses[k, 4])
        axes[k, 1] = math.sin(poses[k, 3]) * math.cos(poses[k, 4])
        axes[k, 2] = -math.sin(poses[k, 4])
    for row in range(stride // 2, xs.size * ys.size * zs.size, stride):
        x, y, z = xs[row // (ys.size * zs.size)], ys[row // zs.size % ys.size], zs[row % zs.size]
        for k in range(drones):
            dx, dy, dz = x - poses[k, 0], y - poses[k, 1], z - poses[k, 2]
            r = max(math.sqrt(dx * dx + dy * dy + dz * dz), 1e-9)
            sight[k, 0], sight[k, 1], sight[k, 2] = dx / r, dy / r, dz / r
            c1 = axes[k, 0] * sight[k, 0] + axes[k, 1] * sight[k, 1] + axes[k, 2] * sight[k, 2]
            base[k] = (1.0 - c1) * (1.0 - c1) * k1 + (r - distance) * (r - distance) * k3
        for j in range(directions.shape[0]):
            best, winner = np.inf, 0
            for k in range(drones):
                t = 1.0 + (
                    directions[j, 0] * sight[k, 0] + directions[j, 1] * sight[k, 1] + directions[j, 2] * sight[k, 2]
                )
                exponent = base[k] + t * t * k2
                if exponent < best:
                    best, winner = exponent, k
            counts[winner] += 1.0
    shares: Floats = counts / counts.sum()
    return shares
