"""Which photographs make up a fragment, and the local volume that they show. Pure geometry, shared with the training.

Keyframes are taken as in NeuralRecon: each far enough from the others of its fragment, the newest first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ground_station.reconstruction.depth_range import depth_range
from ground_station.reconstruction.views import View
from protocol.geometry import Floats
from protocol.mission import Box

FINE_M: Final = 0.04
"""Voxels of the result."""
COARSE: Final = 2
"""Fine voxels along a coarse one's edge."""
HALVED: Final = 4
"""The network halves the coarse volume twice."""
REACH_M: Final = 0.12
"""Distances are cut here, three fine voxels, as in NeuralRecon."""
VIEWS: Final = 8
"""Photographs of a fragment; NeuralRecon takes 9."""
VIEWS_MIN: Final = 3
"""Fewer photographs make no fragment."""
APART_M: Final = 0.2
"""Least distance between two photographs of a fragment; NeuralRecon's 0.1 m serve rooms seen from the side ..."""
APART_RAD: Final = math.radians(15)
"""... unless they are turned by so much (NeuralRecon)."""
OVERLAP_MIN: Final = 0.25
"""Least share of what the newest photograph shows that another one must show too."""
SEEN_SHARE: Final = 0.8
"""Depth at which overlap and the volume's place are judged, as a share of that at which rays leave the target box:
above most floors, below most tops."""
NEAREST_M: Final = 0.1
"""What is closer to a camera than this does not count as seen by it."""
SAMPLES: Final = 4
"""Points across and down an image at which overlap is judged."""


@dataclass(frozen=True, slots=True)
class Window:
    """A local volume on the lattice of the whole map."""

    first: tuple[int, int, int]
    """Fine voxel of the map at its lower corner; even, so that coarse voxels of all windows are the same ones."""
    coarse: tuple[int, int, int]
    """Coarse voxels along x, y, z; multiples of `HALVED`."""

    @property
    def fine(self) -> tuple[int, int, int]:
        x, y, z = self.coarse
        return COARSE * x, COARSE * y, COARSE * z


WINDOW: Final = (32, 32, 28)
"""Coarse voxels of a fragment's window, 2.56 x 2.56 x 2.24 m: what eight views from 1.5 m show, and the paper's box."""


def projection(view: View) -> Floats:
    """(3, 4): homogeneous world point to (u z, v z, z); u and v run from 0 to 1 across and down the image."""
    camera = view.intrinsics
    scale = np.array(
        [
            [camera.fx / camera.width, 0.0, camera.cx / camera.width],
            [0.0, camera.fy / camera.height, camera.cy / camera.height],
            [0.0, 0.0, 1.0],
        ]
    )
    turn = scale @ view.rotation.T
    return np.column_stack([turn, -turn @ view.position])


def looks_at_m(view: View, box: Box) -> float:
    """Depth, along the optical axis, at which overlap and place are judged; 0 if the view misses ``box``."""
    span = depth_range(view, box, REACH_M)
    return SEEN_SHARE * span.typical if span else 0.0


def seen_points(view: View, box: Box) -> Floats:
    """(SAMPLES^2, 3): what the view shows at `looks_at_m`, spread over the image."""
    camera = view.intrinsics
    shares = (np.arange(SAMPLES) + 0.5) / SAMPLES
    across, down = (part.ravel() for part in np.meshgrid(shares * camera.width, shares * camera.height))
    rays = np.column_stack([(across - camera.cx) / camera.fx, (down - camera.cy) / camera.fy, np.ones_like(across)])
    return view.position + looks_at_m(view, box) * rays @ view.rotation.T


def shows(views: Sequence[View], points: Floats) -> NDArray[np.bool_]:
    """(V,) whether a view shows at least `OVERLAP_MIN` of ``points`` (n, 3)."""
    projections = np.stack([projection(view) for view in views])
    images = np.einsum("vij,nj->vni", projections, np.column_stack([points, np.ones(len(points))]))
    depth = images[..., 2]
    inside = ((images[..., :2] >= 0) & (images[..., :2] <= depth[..., None])).all(axis=-1) & (depth > NEAREST_M)
    enough: NDArray[np.bool_] = inside.mean(axis=1) >= OVERLAP_MIN
    return enough


def choose_views(views: Sequence[View], box: Box, count: int = VIEWS) -> list[int]:
    """Places in ``views``, newest first, of at most ``count`` that show what the first does; it is one of them."""
    positions = np.stack([view.position for view in views])
    rotations = np.stack([view.rotation for view in views])
    allowed = shows(views, seen_points(views[0], box))
    allowed[0] = True
    chosen: list[int] = []
    while len(chosen) < count and allowed.any():
        best = int(allowed.argmax())
        chosen.append(best)
        near = np.linalg.norm(positions - positions[best], axis=1) < APART_M
        # trace(R1^T R2) = 1 + 2 cos(angle)
        cosine = (np.einsum("vij,ij->v", rotations, rotations[best]) - 1) / 2
        allowed &= ~(near & (cosine > math.cos(APART_RAD)))
        allowed[best] = False
    return chosen


def place_window(
    centre: Floats, origin: Floats, shape: tuple[int, ...], coarse: tuple[int, int, int] = WINDOW
) -> Window:
    """The window around ``centre`` m, moved into the map whose first voxel lies at ``origin`` and that has ``shape``.

    It is cut where the map is smaller, but for what makes it a multiple of `HALVED` and may reach beyond.
    """
    needed = -(-np.array(shape) // (COARSE * HALVED)) * HALVED
    size = np.minimum(coarse, needed)
    wished = np.rint((centre - origin) / FINE_M - COARSE * size / 2).astype(int)
    first = np.maximum(np.minimum(wished, np.array(shape) - COARSE * size), 0) // COARSE * COARSE
    return Window((int(first[0]), int(first[1]), int(first[2])), (int(size[0]), int(size[1]), int(size[2])))


def middle_of(views: Sequence[View], box: Box) -> Floats:
    """(3,) where ``views`` look, the median of the points in the middle of their images."""
    ahead = [view.position + looks_at_m(view, box) * view.optical_axis for view in views]
    return np.asarray(np.median(ahead, axis=0))
