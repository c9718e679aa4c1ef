"""Fits a lidar's scans to a map that grows from them: KISS-ICP's parts, with a say on how far each result is to be
believed.

KISS-ICP (Vizzo et al., "KISS-ICP: In Defense of Point-to-Point ICP", 2023) guesses from its last two poses and believes
itself. Here the guess is the fused estimate's, a scan enters the map only after the filter has accepted its pose, and
each pose comes with a covariance from the surfaces that the scan saw: over a bare floor, height is known and nothing
else.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from protocol.errors import VehicleError
from protocol.geometry import Floats
from protocol.localization_settings import Lidar

ITERATIONS: Final = 60
"""Of one registration; KISS-ICP's 500 cost seconds where nothing fits."""
CONVERGED: Final = 1e-4
"""KISS-ICP's own."""
NEAR_M: Final = 0.3
"""Points farther from the map are no pairs: a multiple of what a velocity's error makes of a scan's period."""
KERNEL_M: Final = 0.1
"""Scale of its robust kernel, a third of that as in KISS-ICP."""
POINTS_PER_VOXEL: Final = 20
"""KISS-ICP's own."""
TILT_MAX_RAD: Final = 0.1
"""A scan comes levelled: a result that tilts it more is wrong."""
OVERLAP_MIN: Final = 0.5
"""Least share of a scan's points that lie where the map has some. Good ones have 0.99 in the mean and at least 0.65,
what the second scan of a flight has; of points at random it is 0.1."""

NORMALS: Final = 300
"""Points of a scan whose surface is looked at ..."""
NEIGHBOURS: Final = 8
"""... among so many nearest ones."""
FLAT: Final = 0.2
"""Largest ratio of the two smallest spreads among them for a surface to be one."""
TILTED: Final = 0.1
"""Square of the sine by which such a normal is off: so much a flat floor seems to say of sideways motion, and is not
believed."""
POINT_SD_M: Final = 0.05
"""How far a pair of points says where its surface is: pairs are up to half a voxel apart along an uneven one."""
MAP_SD_M: Final = 0.01
"""What no scan can be better than, being fitted to a map of its forerunners ..."""
MAP_SD_RAD: Final = 0.003
"""... likewise."""
UNKNOWN_SD: Final = 10.0
"""Standard deviation, m and rad, of what a scan says nothing of."""


@dataclass(frozen=True, slots=True)
class Registration:
    """One scan's pose by itself."""

    pose: Floats
    """(4,) x, y, z, yaw."""
    covariance: Floats
    """(4, 4)"""
    overlap: float
    """Share of its points that lie where the map has some; 1 for the first, which is the map."""
    tilt_rad: float

    @property
    def fits(self) -> bool:
        return self.overlap >= OVERLAP_MIN and self.tilt_rad <= TILT_MAX_RAD


class ScanRegistration:
    """One thread each; the same scans and guesses give the same poses, byte for byte."""

    def __init__(self, lidar: Lidar) -> None:
        """Raises `VehicleError` where KISS-ICP is not installed."""
        mapping, registration, self._down_sample = load_kiss_icp()
        self._voxel_m = lidar.voxel_m
        self._map: Any = mapping.VoxelHashMap(lidar.voxel_m, lidar.range_max_m, POINTS_PER_VOXEL)
        self._icp: Any = registration.Registration(ITERATIONS, CONVERGED, 1)  # one thread: more change the sums' order
        self._cells = np.empty(0, np.int64), np.empty(0, np.int64)
        """Cells of the map in which there are points, ascending; of two grids, the second shifted by half a voxel: a
        wall that lies between two cells of the one lies within one of the other."""
        self._waiting: Floats | None = None

    def register(self, points: Floats, guess: Floats) -> Registration:
        """Where a scan, (n, 3) levelled and as seen from the sensor, was taken; ``guess`` (4,). The map stays as it is
        until `keep`."""
        self._waiting = self._down_sample(points, self._voxel_m * 0.5)
        if len(self._waiting) <= NEIGHBOURS:
            nothing = np.diag([UNKNOWN_SD**2] * 4)
            return Registration(guess.copy(), nothing, 0.0, 0.0)
        source = self._down_sample(self._waiting, self._voxel_m * 1.5)
        first = self._map.empty()
        placed = transform(guess)
        if not first:
            placed = np.asarray(self._icp.align_points_to_map(source, self._map, placed, NEAR_M, KERNEL_M))
        moved = source @ placed[:3, :3].T
        covariance = pose_covariance(*surfaces(self._waiting @ placed[:3, :3].T, moved))
        cells = self._cells_of(moved + placed[:3, 3])
        known = np.isin(cells[0], self._cells[0]) | np.isin(cells[1], self._cells[1])
        yaw = math.atan2(placed[1, 0], placed[0, 0])
        return Registration(
            np.array([*placed[:3, 3], yaw]),
            covariance,
            1.0 if first else float(known.mean()),
            math.acos(min(1.0, max(-1.0, placed[2, 2]))),
        )

    def keep(self, pose: Floats) -> None:
        """Add the scan registered last to the map, as taken at ``pose`` (4,)."""
        if self._waiting is None or not len(self._waiting):
            return
        placed = transform(pose)
        self._map.update(self._waiting, placed)
        cells = self._cells_of(self._waiting @ placed[:3, :3].T + placed[:3, 3])
        self._cells = np.union1d(self._cells[0], cells[0]), np.union1d(self._cells[1], cells[1])
        self._waiting = None

    def _cells_of(self, points: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """A number for each point's cell in both grids."""
        steps = [np.floor(points / self._voxel_m + shift).astype(np.int64) + 2**20 for shift in (0.0, 0.5)]
        first, second = ((step[:, 0] << 42) | (step[:, 1] << 21) | step[:, 2] for step in steps)
        return first, second


def load_kiss_icp() -> tuple[Any, Any, Any]:
    """The modules ``mapping`` and ``registration``, and the function that thins points out.

    Raises:
        VehicleError: it is not installed.
    """
    try:
        from kiss_icp import mapping, registration
        from kiss_icp.voxelization import voxel_down_sample
    except ImportError as error:
        raise VehicleError(
            'localization.source = "lidar" needs KISS-ICP: pip install "coverage-recon[lidar]"'
        ) from error
    return mapping, registration, voxel_down_sample


def transform(pose: Floats) -> Floats:
    """(4, 4) of x, y, z, yaw."""
    matrix = np.eye(4)
    cosine, sine = math.cos(pose[3]), math.sin(pose[3])
    matrix[:2, :2] = ((cosine, -sine), (sine, cosine))
    matrix[:3, 3] = pose[:3]
    return matrix


def surfaces(points: Floats, source: Floats) -> tuple[Floats, Floats, float]:
    """Places (m, 3) and normals (m, 3) of the flat surfaces at some of ``source``, among ``points``; and how many
    points of ``source`` each of them stands for. All (n, 3) relative to the sensor, turned into the world's axes."""
    chosen = source[:: max(1, len(source) // NORMALS)]
    _, near = cKDTree(points).query(chosen, NEIGHBOURS)
    offsets = points[near] - points[near].mean(axis=1, keepdims=True)
    spreads, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))
    flat = spreads[:, 0] < FLAT**2 * spreads[:, 1]
    return chosen[flat], axes[flat, :, 0], len(source) / max(1, len(chosen))


def pose_covariance(places: Floats, normals: Floats, weight: float) -> Floats:
    """(4, 4) of x, y, z, yaw: the inverse of what point-to-plane pairs say of them, no smaller than the map's own error
    and no larger than `UNKNOWN_SD`. A pair at q with normal n says n . (dp + dyaw z x q)."""
    rows = np.empty((len(places), 4))
    rows[:, :3] = normals
    rows[:, 3] = normals[:, 1] * places[:, 0] - normals[:, 0] * places[:, 1]
    reach = float((places[:, :2] ** 2).sum())
    seeming = TILTED * np.diag([len(places)] * 3 + [reach])
    values, vectors = np.linalg.eigh((rows.T @ rows - seeming) * (weight / POINT_SD_M**2))
    variances = 1 / np.maximum(values, 1 / UNKNOWN_SD**2)
    covariance: Floats = (vectors * variances) @ vectors.T
    covariance += np.diag([MAP_SD_M**2] * 3 + [MAP_SD_RAD**2])
    return covariance
