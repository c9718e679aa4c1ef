"""The simulated camera: what a drone at a pose would photograph, on the CPU, byte for byte repeatable."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.special import ndtri

from protocol.geometry import Intrinsics, camera_rotation
from sim_bridge.rasteriser import CLUSTER, SETUP, find_nearest, shade
from sim_bridge.scenes.scene import Scene

BACKGROUND = (176, 190, 204)
"""Colour where nothing is hit: an overcast sky."""

_NOISE_BITS = 12
"""The normal distribution is drawn from 2^12 quantiles: out to 3.5 sigma, standard deviation right to 0.1 %."""


class Camera:
    """Renders one scene with one set of intrinsics. Holds scratch buffers: use one camera per thread."""

    def __init__(self, scene: Scene, intrinsics: Intrinsics) -> None:
        self._scene = scene
        self._intrinsics = intrinsics
        self._focal = (intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy)
        self._planes = _planes(scene.triangles)
        self._spheres = _bounding_spheres(scene.triangles)
        edges = scene.uv[:, 1:] - scene.uv[:, :1]
        sizes = scene.textures.sizes[scene.texture]
        areas = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
        self._texel_areas = (areas * sizes[:, 0] * sizes[:, 1]).astype(np.float32)
        shape = (intrinsics.height, intrinsics.width)
        self._inverse_depth = np.zeros(shape, dtype=np.float32)
        self._drawn = np.zeros(shape, dtype=np.int32)
        self._setups = np.empty((len(scene.triangles), SETUP), dtype=np.float64)
        self._faces = np.empty(len(scene.triangles), dtype=np.int32)

    def render(self, pose: Sequence[float]) -> NDArray[np.uint8]:
        """Photograph, RGB [H, W, 3]; ``pose`` is x, y, z, yaw, pitch as in `protocol.geometry`."""
        self._rasterise(pose)
        image = np.empty((*self._drawn.shape, 3), dtype=np.uint8)
        scene, textures = self._scene, self._scene.textures
        shade(
            self._drawn,
            self._setups,
            self._faces,
            scene.uv,
            scene.light,
            scene.texture,
            textures.texels,
            textures.offsets,
            textures.sizes,
            BACKGROUND,
            image,
        )
        return image

    def render_depth(self, pose: Sequence[float]) -> NDArray[np.float32]:
        """Depth along the optical axis, metres [H, W]; +inf where nothing is hit."""
        self._rasterise(pose)
        depth = np.full(self._inverse_depth.shape, np.inf, dtype=np.float32)
        np.divide(np.float32(1.0), self._inverse_depth, out=depth, where=self._inverse_depth > 0)
        return depth

    def _rasterise(self, pose: Sequence[float]) -> None:
        x, y, z, yaw, pitch = pose
        find_nearest(
            self._scene.triangles,
            self._planes,
            self._scene.two_sided,
            self._texel_areas,
            self._spheres,
            np.array([x, y, z], dtype=np.float64),
            np.ascontiguousarray(camera_rotation(yaw, pitch)),
            self._focal,
            self._inverse_depth,
            self._drawn,
            self._setups,
            self._faces,
        )


def add_noise(image: NDArray[np.uint8], sigma: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The image with independent normal noise of ``sigma`` grey levels on every channel, rounded and clipped."""
    if sigma <= 0:
        return image
    steps = np.rint(sigma * _normal_quantiles()).astype(np.int16)
    noisy = np.empty_like(image)
    _add_steps(image.reshape(-1), steps, rng.integers(1, 2**64, dtype=np.uint64), noisy.reshape(-1))
    return noisy


def add_depth_noise(
    depth: NDArray[np.float32], near_m: float, per_m: float, rng: np.random.Generator
) -> NDArray[np.float32]:
    """``depth`` (H, W) m with independent normal noise of standard deviation ``near_m + per_m * depth ** 2``."""
    if near_m <= 0 and per_m <= 0:
        return depth
    noise = _normal_quantiles()[rng.integers(0, 1 << _NOISE_BITS, depth.shape)]
    known = np.isfinite(depth)
    spread = near_m + per_m * np.square(depth, where=known, out=np.zeros_like(depth))
    return np.where(known, depth + np.where(known, noise * spread, 0), depth).astype(np.float32)


@cache
def _normal_quantiles() -> NDArray[np.float64]:
    count = 1 << _NOISE_BITS
    quantiles: NDArray[np.float64] = ndtri((np.arange(count) + 0.5) / count)
    return quantiles


@njit(cache=True, nogil=True)
def _add_steps(values: NDArray[np.uint8], steps: NDArray[np.int16], seed: np.uint64, noisy: NDArray[np.uint8]) -> None:
    # xorshift64 (Marsaglia 2003) with every operand uint64: a mixed type would turn it into float.
    state = np.uint64(seed)
    mask = np.uint64((1 << _NOISE_BITS) - 1)
    draws = 5  # times 12 bits; the low bits of the state stay unused
    for start in range(0, values.size, draws):
        state ^= state << np.uint64(13)
        state ^= state >> np.uint64(7)
        state ^= state << np.uint64(17)
        bits = state >> np.uint64(4)
        for index in range(start, min(start + draws, values.size)):
            noisy[index] = min(255, max(0, values[index] + steps[bits & mask]))
            bits >>= np.uint64(_NOISE_BITS)


def _planes(triangles: NDArray[np.float32]) -> NDArray[np.float32]:
    """Unit normal and offset of each triangle, [T, 4]; degenerate ones get zeros and are never drawn."""
    exact = triangles.astype(np.float64)
    normals = np.cross(exact[:, 1] - exact[:, 0], exact[:, 2] - exact[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    np.divide(normals, lengths, out=normals, where=lengths > 0)
    return np.column_stack([normals, np.einsum("ij,ij->i", normals, exact[:, 0])]).astype(np.float32)


def _bounding_spheres(triangles: NDArray[np.float32]) -> NDArray[np.float32]:
    """Centre and radius around each cluster of triangles, [C, 4]."""
    starts = np.arange(0, len(triangles), CLUSTER)
    low = np.minimum.reduceat(triangles.min(axis=1), starts)
    high = np.maximum.reduceat(triangles.max(axis=1), starts)
    centre = (low + high) / 2
    radius = np.linalg.norm(high - centre, axis=1) * np.float32(1 + 1e-5)  # rounding must not cut a corner off
    return np.column_stack([centre, radius]).astype(np.float32)
