"""The z-buffer that draws a scene: the hot path of the simulator, compiled by numba.

Triangles are drawn in homogeneous coordinates (Olano and Greer, "Triangle scan conversion using 2D homogeneous
coordinates", 1997): with the projected corners as columns of M, the rows of M^-1 give, at pixel (x, y), the
barycentric weights divided by depth. They are linear in x and y whichever side of the camera a corner lies on, so
the near plane is one more linear bound and no triangle is ever cut.

The first pass finds the nearest triangle of each pixel, the second shades each pixel once. No ``fastmath``: plain
IEEE arithmetic gives the same bytes on every machine.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

NEAR_M = 0.05
"""What is nearer than this along the optical axis is not drawn."""
CLUSTER = 64
"""Consecutive triangles that are culled together."""
SETUP = 10
"""float64 values kept for a triangle that may be seen: three linear functions, and texels per pixel / depth^3."""
OVERLAP_PX = 1e-3
"""Triangles are drawn this much larger, so that rounding never leaves a hole where two of them meet."""

_WEIGHT_BITS = 6
_WEIGHT_STEPS = 1 << _WEIGHT_BITS
"""Steps between two texels; 64 x 64 x 255 fits in a third of 64 bits, so one product weighs a whole colour."""
_LANE_BITS = 20
_LANE_MASK = (1 << _LANE_BITS) - 1
_NOTHING = -1


@njit(cache=True, nogil=True, inline="always")
def _narrowed(low: float, high: float, value: float, slope: float, inverse_slope: float) -> tuple[float, float]:
    """The part of [low, high] where ``value + slope * x`` is not negative."""
    if slope > 0.0:
        return max(low, -value * inverse_slope), high
    if slope < 0.0:
        return low, min(high, -value * inverse_slope)
    if value < 0.0:
        return 1.0, 0.0
    return low, high


@njit(cache=True, nogil=True)
def find_nearest(
    triangles: NDArray[np.float32],
    planes: NDArray[np.float32],
    two_sided: NDArray[np.bool_],
    texel_areas: NDArray[np.float32],
    spheres: NDArray[np.float32],
    position: NDArray[np.float64],
    rotation: NDArray[np.float64],
    intrinsics: tuple[float, float, float, float],
    inverse_depth: NDArray[np.float32],
    drawn: NDArray[np.int32],
    setups: NDArray[np.float64],
    faces: NDArray[np.int32],
) -> None:
    """First pass: the nearest triangle of each pixel.

    ``triangles`` [T, 3, 3] world, ``planes`` [T, 4] unit normal and offset, ``texel_areas`` [T] twice the area in
    texels, ``spheres`` [ceil(T / CLUSTER), 4] around each cluster, ``rotation`` camera to world, ``intrinsics``
    fx, fy, cx, cy. Written: ``inverse_depth`` [H, W] (0: nothing), ``drawn`` [H, W] row of ``setups`` and ``faces``
    (-1: nothing), ``setups`` [T, SETUP], ``faces`` [T].
    """
    height, width = inverse_depth.shape
    fx, fy, cx, cy = intrinsics
    r00, r10, r20 = rotation[0, 0], rotation[1, 0], rotation[2, 0]
    r01, r11, r21 = rotation[0, 1], rotation[1, 1], rotation[2, 1]
    r02, r12, r22 = rotation[0, 2], rotation[1, 2], rotation[2, 2]
    px, py, pz = position[0], position[1], position[2]
    left = 1.0 / math.hypot(fx, cx)
    right = 1.0 / math.hypot(fx, width - cx)
    top = 1.0 / math.hypot(fy, cy)
    bottom = 1.0 / math.hypot(fy, height - cy)
    corner = np.empty((3, 3), dtype=np.float64)
    inverse_near = 1.0 / NEAR_M
    count = 0
    inverse_depth[:] = 0.0
    drawn[:] = _NOTHING

    for cluster in range(spheres.shape[0]):
        dx, dy, dz = spheres[cluster, 0] - px, spheres[cluster, 1] - py, spheres[cluster, 2] - pz
        radius = spheres[cluster, 3]
        x = r00 * dx + r10 * dy + r20 * dz
        y = r01 * dx + r11 * dy + r21 * dz
        z = r02 * dx + r12 * dy + r22 * dz
        if (
            z < NEAR_M - radius
            or (fx * x + cx * z) * left < -radius
            or ((width - cx) * z - fx * x) * right < -radius
            or (fy * y + cy * z) * top < -radius
            or ((height - cy) * z - fy * y) * bottom < -radius
        ):
            continue
        for face in range(cluster * CLUSTER, min((cluster + 1) * CLUSTER, triangles.shape[0])):
            facing = planes[face, 0] * px + planes[face, 1] * py + planes[face, 2] * pz - planes[face, 3]
            if facing <= 0.0 and not two_sided[face]:
                continue
            in_front = 0
            for index in range(3):
                dx = triangles[face, index, 0] - px
                dy = triangles[face, index, 1] - py
                dz = triangles[face, index, 2] - pz
                z = r02 * dx + r12 * dy + r22 * dz
                # Integer coordinates are pixel centres from here on.
                corner[index, 0] = fx * (r00 * dx + r10 * dy + r20 * dz) + (cx - 0.5) * z
                corner[index, 1] = fy * (r01 * dx + r11 * dy + r21 * dz) + (cy - 0.5) * z
                corner[index, 2] = z
                if z >= NEAR_M:
                    in_front += 1
            if in_front == 0:
                continue

            x_low, x_high, y_low, y_high = math.inf, -math.inf, math.inf, -math.inf
            nearest, farthest = inverse_near, math.inf
            for index in range(3):
                z = corner[index, 2]
                following = (index + 1) % 3
                if z >= NEAR_M:
                    inverse = 1.0 / z
                    farthest = min(farthest, inverse)
                    x_low, x_high = min(x_low, corner[index, 0] * inverse), max(x_high, corner[index, 0] * inverse)
                    y_low, y_high = min(y_low, corner[index, 1] * inverse), max(y_high, corner[index, 1] * inverse)
                if in_front < 3 and (z >= NEAR_M) != (corner[following, 2] >= NEAR_M):
                    share = (NEAR_M - z) / (corner[following, 2] - z)
                    x = (corner[index, 0] + share * (corner[following, 0] - corner[index, 0])) * inverse_near
                    y = (corner[index, 1] + share * (corner[following, 1] - corner[index, 1])) * inverse_near
                    x_low, x_high = min(x_low, x), max(x_high, x)
                    y_low, y_high = min(y_low, y), max(y_high, y)
            x_low, x_high = max(x_low - OVERLAP_PX, 0.0), min(x_high + OVERLAP_PX, width - 1.0)
            y_low, y_high = max(y_low - OVERLAP_PX, 0.0), min(y_high + OVERLAP_PX, height - 1.0)
            # A small triangle often lies between pixel centres: most rejections happen here.
            if math.ceil(x_low) > math.floor(x_high) or math.ceil(y_low) > math.floor(y_high):
                continue
            if in_front == 3:
                nearest = 1.0 / min(corner[0, 2], corner[1, 2], corner[2, 2])

            setup = setups[count]
            for index in range(3):
                a, b = (index + 1) % 3, (index + 2) % 3
                setup[3 * index] = corner[a, 1] * corner[b, 2] - corner[a, 2] * corner[b, 1]
                setup[3 * index + 1] = corner[a, 2] * corner[b, 0] - corner[a, 0] * corner[b, 2]
                setup[3 * index + 2] = corner[a, 0] * corner[b, 1] - corner[a, 1] * corner[b, 0]
            determinant = corner[0, 0] * setup[0] + corner[0, 1] * setup[1] + corner[0, 2] * setup[2]
            if determinant == 0.0:
                continue
            inverse = 1.0 / determinant
            for index in range(9):
                setup[index] *= inverse
            setup[9] = abs(texel_areas[face] * inverse)
            faces[count] = face
            _draw(setup, count, in_front < 3, (x_low, x_high, y_low, y_high), (farthest, nearest), inverse_depth, drawn)
            count += 1


@njit(cache=True, nogil=True)
def _draw(
    setup: NDArray[np.float64],
    number: int,
    cut_by_near: bool,
    bounds_px: tuple[float, float, float, float],
    inverse_depths: tuple[float, float],
    inverse_depth: NDArray[np.float32],
    drawn: NDArray[np.int32],
) -> None:
    x_low, x_high, y_low, y_high = bounds_px
    a0, b0, a1, b1, a2, b2 = setup[0], setup[1], setup[3], setup[4], setup[6], setup[7]
    c0 = setup[2] + OVERLAP_PX * (abs(a0) + abs(b0))
    c1 = setup[5] + OVERLAP_PX * (abs(a1) + abs(b1))
    c2 = setup[8] + OVERLAP_PX * (abs(a2) + abs(b2))
    i0 = 1.0 / a0 if a0 != 0.0 else 0.0
    i1 = 1.0 / a1 if a1 != 0.0 else 0.0
    i2 = 1.0 / a2 if a2 != 0.0 else 0.0
    a, b, c = a0 + a1 + a2, b0 + b1 + b2, setup[2] + setup[5] + setup[8]
    i = 1.0 / a if a != 0.0 else 0.0
    slope = np.float32(a)
    # Extrapolating by the overlap must not bring an edge-on triangle nearer than its corners.
    farthest, nearest = np.float32(inverse_depths[0]), np.float32(inverse_depths[1])
    if cut_by_near:
        farthest = np.float32(0.0)
    for y in range(math.ceil(y_low), math.floor(y_high) + 1):
        low, high = _narrowed(x_low, x_high, c0 + b0 * y, a0, i0)
        low, high = _narrowed(low, high, c1 + b1 * y, a1, i1)
        low, high = _narrowed(low, high, c2 + b2 * y, a2, i2)
        here = c + b * y
        if cut_by_near:
            low, high = _narrowed(low, high, 1.0 / NEAR_M - here, -a, -i)
        if low > high:
            continue
        start, stop = math.ceil(low), math.floor(high) + 1
        first = np.float32(here + a * start)
        for x in range(start, stop):
            value = min(max(first + slope * np.float32(x - start), farthest), nearest)
            if value > inverse_depth[y, x]:
                inverse_depth[y, x] = value
                drawn[y, x] = number


@njit(cache=True, nogil=True, inline="always")
def _spread(texel: int) -> int:
    """Red, green, blue 8 bits apart -> ``_LANE_BITS`` apart."""
    return (texel & 0xFF) | (texel & 0xFF00) << (_LANE_BITS - 8) | (texel & 0xFF0000) << (2 * _LANE_BITS - 16)


@njit(cache=True, nogil=True, inline="always")
def _bilinear(texels: NDArray[np.uint32], start: int, width: int, height: int, u: float, v: float) -> int:
    """Colour at (u, v) of a repeating level, each channel times ``_WEIGHT_STEPS`` squared in its lane."""
    column = math.floor(u * (width * _WEIGHT_STEPS)) - _WEIGHT_STEPS // 2
    row = math.floor(v * (height * _WEIGHT_STEPS)) - _WEIGHT_STEPS // 2
    x, y = column & (_WEIGHT_STEPS - 1), row & (_WEIGHT_STEPS - 1)
    column, row = column >> _WEIGHT_BITS, row >> _WEIGHT_BITS
    left, right = column & (width - 1), (column + 1) & (width - 1)
    upper, lower = start + (row & (height - 1)) * width, start + ((row + 1) & (height - 1)) * width
    return (_spread(int(texels[upper + left])) * (_WEIGHT_STEPS - x) + _spread(int(texels[upper + right])) * x) * (
        _WEIGHT_STEPS - y
    ) + (_spread(int(texels[lower + left])) * (_WEIGHT_STEPS - x) + _spread(int(texels[lower + right])) * x) * y


@njit(cache=True, nogil=True, inline="always")
def _channel(fine: int, coarse: int, lane: int, share: float, lit: float) -> np.uint8:
    """One channel of the pixel: between two mip levels, times the light."""
    finer, coarser = float(fine >> lane & _LANE_MASK), float(coarse >> lane & _LANE_MASK)
    value = (finer + share * (coarser - finer)) * lit * (1.0 / (_WEIGHT_STEPS * _WEIGHT_STEPS)) + 0.5
    return np.uint8(min(255.0, max(0.0, value)))


@njit(cache=True, nogil=True)
def shade(
    drawn: NDArray[np.int32],
    setups: NDArray[np.float64],
    faces: NDArray[np.int32],
    uv: NDArray[np.float32],
    light: NDArray[np.float32],
    texture: NDArray[np.int32],
    texels: NDArray[np.uint32],
    offsets: NDArray[np.int64],
    sizes: NDArray[np.int32],
    background: tuple[int, int, int],
    image: NDArray[np.uint8],
) -> None:
    """Second pass: trilinear texture times light, into ``image`` [H, W, 3]."""
    height, width = drawn.shape
    # Texture coordinates and light over depth are linear in x too: their values and slopes along a run of pixels.
    start_of = np.empty(6)
    slope_of = np.empty(6)
    for y in range(height):
        stop = 0
        while stop < width:
            start = stop
            number = drawn[y, start]
            while stop < width and drawn[y, stop] == number:
                stop += 1
            if number < 0:
                for x in range(start, stop):
                    for channel in range(3):
                        image[y, x, channel] = background[channel]
                continue
            face = faces[number]
            setup = setups[number]
            slope_of[:] = 0.0
            start_of[:] = 0.0
            for index in range(3):
                slope = setup[3 * index]
                value = slope * start + setup[3 * index + 1] * y + setup[3 * index + 2]
                for kind in range(6):
                    if kind == 0:
                        factor = np.float64(1.0)
                    elif kind < 3:
                        factor = np.float64(uv[face, index, kind - 1])
                    else:
                        factor = np.float64(light[face, index, kind - 3])
                    slope_of[kind] += slope * factor
                    start_of[kind] += value * factor
            w, u, v, red, green, blue = start_of
            dw, du, dv, dred, dgreen, dblue = slope_of
            density = setup[9]
            number = texture[face]
            level_width, level_height, last = (
                np.int64(sizes[number, 0]),
                np.int64(sizes[number, 1]),
                sizes[number, 2] - 1,
            )
            for x in range(start, stop):
                along = float(x - start)
                depth = 1.0 / (w + dw * along)
                # log2 of a float32 is nearly its bit pattern; half of log2(texels per pixel) is the mip level.
                area = np.float32(density * (depth * depth * depth))
                level = max(0.0, 0.5 * (np.float64(area.view(np.int32)) / (1 << 23) - 127.0))
                fine = min(int(level), last)
                coarse = min(fine + 1, last)
                s, t = (u + du * along) * depth, (v + dv * along) * depth
                near_colour = _bilinear(
                    texels, offsets[number, fine], max(1, level_width >> fine), max(1, level_height >> fine), s, t
                )
                far_colour = _bilinear(
                    texels, offsets[number, coarse], max(1, level_width >> coarse), max(1, level_height >> coarse), s, t
                )
                share = min(level - fine, 1.0)
                image[y, x, 0] = _channel(near_colour, far_colour, 0, share, (red + dred * along) * depth)
                image[y, x, 1] = _channel(near_colour, far_colour, _LANE_BITS, share, (green + dgreen * along) * depth)
                image[y, x, 2] = _channel(
                    near_colour, far_colour, 2 * _LANE_BITS, share, (blue + dblue * along) * depth
                )
