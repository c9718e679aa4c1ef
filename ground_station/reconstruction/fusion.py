"""The map: a truncated signed distance volume over the box to be mapped, into which depth maps are averaged.

Curless and Levoy, 1996. Distances are measured along the optical axis. The volume is dense: the target's box is known
and small, and a dense array is what the CPU's caches and the mesh extraction like best.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ground_station.reconstruction.views import View
from protocol.errors import ReconstructionError
from protocol.geometry import Floats
from protocol.mission import Box

BYTES_PER_VOXEL: Final = 11
"""float32 distance, float32 weight, 3 bytes of colour."""
BYTES_MAX: Final = 8 * 2**30
"""A volume above this is a mistake in the mission file, not a wish."""
WEIGHT_MAX: Final = 20.0
"""Older views of a voxel are forgotten beyond this weight, so that a moved thing is mapped anew."""


class Volume:
    """``distance`` (X, Y, Z) m, positive in front of surfaces; ``weight`` 0 where never seen; ``color`` (X, Y, Z, 3).

    Voxel (i, j, k) is sampled at ``origin + voxel * (i, j, k)``. The box of the mission grows by the truncation on
    every side, so that a surface in its faces has a front and a back. The paper's B at 2.5 cm takes 60 MB.
    """

    def __init__(self, box: Box, voxel_m: float, truncation_m: float) -> None:
        self.origin, shape = _lattice(box, voxel_m, truncation_m)
        if float(np.prod(shape.astype(float))) * BYTES_PER_VOXEL > BYTES_MAX:
            raise ReconstructionError(
                f"reconstruction.voxel_m {voxel_m:g}: the volume would take over {BYTES_MAX >> 30} GiB"
            )
        self.voxel = voxel_m
        self.truncation = truncation_m
        self.distance = np.zeros(shape, np.float32)
        self.weight = np.zeros(shape, np.float32)
        self.color = np.zeros((*shape, 3), np.uint8)

    @staticmethod
    def voxels(box: Box, voxel_m: float, truncation_m: float) -> tuple[int, int, int]:
        """How many along x, y and z one would have."""
        x, y, z = _lattice(box, voxel_m, truncation_m)[1].tolist()
        return x, y, z

    @property
    def size_bytes(self) -> int:
        return self.distance.nbytes + self.weight.nbytes + self.color.nbytes

    def state(self) -> dict[str, NDArray[Any]]:
        """What `restore` needs, less than half of the memory: most voxels were never seen, or only seen through.

        Bit-exact. Compressing it further would take ten times as long and save a seventh.
        """
        seen = self.weight > 0
        near = self._near(seen)
        return {
            "seen": np.packbits(seen),
            "near": np.packbits(near),
            "weight": self.weight[seen],
            "distance": self.distance[near],
            "color": self.color[near],
        }

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Be the volume that ``state`` was taken of. Raises `ReconstructionError` if that was another box or voxel."""
        size = self.weight.size
        masks = [np.unpackbits(state[name]).astype(bool) for name in ("seen", "near")]
        counts = [np.count_nonzero(mask) for mask in masks]
        lengths = [len(state[name]) for name in ("weight", "distance", "color")]
        if any(len(mask) != 8 * -(-size // 8) for mask in masks) or lengths != [counts[0], counts[1], counts[1]]:
            raise ReconstructionError(f"the state of a volume does not fit one of {self.weight.shape} voxels")
        seen, near = (mask[:size].reshape(self.weight.shape) for mask in masks)
        self.weight[:] = 0
        self.distance[:] = 0
        self.color[:] = 0
        self.weight[seen] = state["weight"]
        self.distance[seen] = self.truncation
        self.distance[near] = state["distance"]
        self.color[near] = state["color"]

    def _near(self, seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Which of the voxels ``seen`` hold more than "in front of the surface by at least the truncation"."""
        near: NDArray[np.bool_] = self.distance != np.float32(self.truncation)
        for channel in range(3):
            near |= self.color[..., channel] != 0
        near &= seen
        return near

    def integrate(
        self, view: View, depth: NDArray[np.float32], weight: NDArray[np.float32], color: NDArray[np.uint8]
    ) -> None:
        """Average in ``depth`` (H, W) m, 0 where unknown, with ``weight`` (H, W) and ``color`` (H, W, 3)."""
        farthest = float(depth.max(initial=0.0)) + self.truncation
        if farthest <= self.truncation:
            return
        height, width = depth.shape
        corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]]) - [0.5, 0.5, 0.0]
        rays = corners @ np.linalg.inv(view.calibration).T @ view.rotation.T
        reach = np.vstack([view.position, view.position + farthest * rays])
        lower = np.floor((reach.min(axis=0) - self.origin) / self.voxel).astype(int)
        upper = np.ceil((reach.max(axis=0) - self.origin) / self.voxel).astype(int) + 1
        lower, upper = np.maximum(lower, 0), np.minimum(upper, self.distance.shape)
        to_pixel = view.calibration @ view.rotation.T
        _integrate(
            self.distance,
            self.weight,
            self.color,
            depth,
            weight,
            color,
            (to_pixel * self.voxel).astype(np.float32),
            (to_pixel @ (self.origin - view.position)).astype(np.float32),
            lower,
            upper,
            np.float32(farthest),
            np.float32(self.truncation),
        )

    def blend(
        self,
        first: tuple[int, int, int],
        distance: NDArray[np.float32],
        weight: NDArray[np.float32],
        color: NDArray[np.uint8],
    ) -> None:
        """Average in a block of voxels (X, Y, Z) from voxel ``first`` on; what reaches beyond the volume is left out.

        ``distance`` as in the volume, ``weight`` 0 for what is not known, ``color`` (X, Y, Z, 3), black for no colour.
        """
        size = [
            min(count, have - low) for count, have, low in zip(distance.shape, self.distance.shape, first, strict=True)
        ]
        here = tuple(slice(low, low + count) for low, count in zip(first, size, strict=True))
        block = tuple(slice(count) for count in size)
        _blend(self.distance[here], self.weight[here], self.color[here], distance[block], weight[block], color[block])


def _lattice(box: Box, voxel_m: float, truncation_m: float) -> tuple[Floats, NDArray[np.int64]]:
    """Place of the first voxel and number of voxels along each axis."""
    margin = voxel_m * np.ceil(truncation_m / voxel_m)
    origin = np.array(box.lower_m) - margin
    return origin, np.ceil((np.array(box.upper_m) + margin - origin) / voxel_m - 1e-6).astype(int) + 1


@njit(cache=True, nogil=True, error_model="numpy")
def _blend(
    distance: NDArray[np.float32],
    total_weight: NDArray[np.float32],
    total_color: NDArray[np.uint8],
    new_distance: NDArray[np.float32],
    weight: NDArray[np.float32],
    color: NDArray[np.uint8],
) -> None:
    for i in range(distance.shape[0]):
        for j in range(distance.shape[1]):
            for k in range(distance.shape[2]):
                gain = weight[i, j, k]
                if gain <= np.float32(0):
                    continue
                old = total_weight[i, j, k]
                share = gain / (old + gain)
                distance[i, j, k] += (new_distance[i, j, k] - distance[i, j, k]) * share
                total_weight[i, j, k] = min(old + gain, np.float32(WEIGHT_MAX))
                if color[i, j, k].any():
                    _tint(total_color[i, j, k], color[i, j, k], share)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _tint(total: NDArray[np.uint8], color: NDArray[np.uint8], share: np.float32) -> None:
    # Black is the colour of a voxel that so far was only seen through.
    blend = share if total[0] or total[1] or total[2] else np.float32(1)
    for channel in range(3):
        kept = np.float32(total[channel])
        total[channel] = np.uint8(kept + (np.float32(color[channel]) - kept) * blend + np.float32(0.5))


@njit(cache=True, nogil=True, error_model="numpy")
def _cut(first: float, last: float, constant: float, slope: float) -> tuple[float, float]:
    """The part of [first, last] in which ``constant + slope * k >= 0``."""
    if slope > 0:
        return max(first, -constant / slope), last
    if slope < 0:
        return first, min(last, -constant / slope)
    return (first, last) if constant >= 0 else (first, first - 1.0)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _integrate(
    distance: NDArray[np.float32],
    total_weight: NDArray[np.float32],
    total_color: NDArray[np.uint8],
    depth: NDArray[np.float32],
    weight: NDArray[np.float32],
    color: NDArray[np.uint8],
    step: NDArray[np.float32],
    start: NDArray[np.float32],
    lower: NDArray[np.int64],
    upper: NDArray[np.int64],
    farthest: np.float32,
    truncation: np.float32,
) -> None:
    """``start + step @ (i, j, k)`` is a voxel's homogeneous pixel index, its last entry the depth in metres."""
    height, width = depth.shape
    half, nearest = np.float32(0.5), np.float32(0.05)
    right, bottom = np.float32(width - 0.51), np.float32(height - 0.51)
    step_u, step_v, step_z = step[0, 2], step[1, 2], step[2, 2]
    for i in range(lower[0], upper[0]):
        for j in range(lower[1], upper[1]):
            base_u = start[0] + step[0, 0] * i + step[0, 1] * j
            base_v = start[1] + step[1, 0] * i + step[1, 1] * j
            base_z = start[2] + step[2, 0] * i + step[2, 1] * j
            # The column's part inside the view, so that the loop below needs no bounds.
            first, last = _cut(float(lower[2]), float(upper[2] - 1), base_z - nearest, step_z)
            first, last = _cut(first, last, farthest - base_z, -step_z)
            first, last = _cut(first, last, base_u + half * base_z, step_u + half * step_z)
            first, last = _cut(first, last, base_v + half * base_z, step_v + half * step_z)
            first, last = _cut(first, last, right * base_z - base_u, right * step_z - step_u)
            first, last = _cut(first, last, bottom * base_z - base_v, bottom * step_z - step_v)
            for k in range(int(np.ceil(first)), int(np.floor(last)) + 1):
                z = base_z + step_z * k
                inverse = np.float32(1) / z
                column = int(min(max((base_u + step_u * k) * inverse + half, np.float32(0)), np.float32(width - 1)))
                row = int(min(max((base_v + step_v * k) * inverse + half, np.float32(0)), np.float32(height - 1)))
                measured = depth[row, column]
                signed = measured - z
                if measured <= np.float32(0) or signed < -truncation:
                    continue
                gain = weight[row, column]
                old = total_weight[i, j, k]
                share = gain / (old + gain)
                distance[i, j, k] += (min(signed, truncation) - distance[i, j, k]) * share
                total_weight[i, j, k] = min(old + gain, np.float32(WEIGHT_MAX))
                if signed < truncation:
                    # Black is the colour of a voxel that so far was only seen through.
                    blank = (
                        total_color[i, j, k, 0] == 0 and total_color[i, j, k, 1] == 0 and total_color[i, j, k, 2] == 0
                    )
                    blend = np.float32(1) if blank else share
                    for channel in range(3):
                        kept = np.float32(total_color[i, j, k, channel])
                        shade = kept + (np.float32(color[row, column, channel]) - kept) * blend
                        total_color[i, j, k, channel] = np.uint8(shade + half)
