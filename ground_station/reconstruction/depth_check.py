"""Whether measured depth can be believed: other views must have measured the same, and images must fit together by it.

The second is for what the first cannot see: a factor in all depths, as of a camera that counts in another unit. Over a
flat floor every view confirms every other whatever the factor, but what the images show moves by the right depth alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ground_station.reconstruction.consistency import TOLERANCE
from ground_station.reconstruction.reconstructor import Refusal
from ground_station.reconstruction.views import View
from protocol.geometry import Floats

NEAREST_M: Final = 0.05
"""What is nearer is the camera's own fault: a finger, or metres where millimetres were meant."""
COMPARED_MIN: Final = 0.05
"""Least share of the pixels that others measured as well."""
CONFIRMED_MIN: Final = 0.4
"""Least share of those that others confirm, as of the plane sweep."""
FACTORS: Final = (1.0, 0.5, 0.7, 0.83, 0.91, 1.1, 1.2, 1.43, 2.0)
"""By which all depths may be wrong; the right one comes first."""
CORRELATION_MIN: Final = 0.5
"""Of two images by another factor, from which on it is believed ..."""
CORRELATION_GAIN: Final = 0.1
"""... if it is so much better: without texture, and in the dark, none is."""


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    view: View
    depth: NDArray[np.float32]
    """(H, W) m, the size of the view; 0 where unknown."""

    def surface(self) -> Floats:
        """(N, 3) m, world: what its pixels with depth show."""
        rows, columns = np.nonzero(self.depth)
        pixels = np.column_stack([columns, rows, np.ones(rows.size)])
        rays = pixels @ np.linalg.inv(self.view.calibration).T @ self.view.rotation.T  # one metre of depth each
        points: Floats = self.view.position + self.depth[rows, columns, None] * rays
        return points


def fault_of(measured: Measured, others: Sequence[Measured]) -> Refusal | None:
    """Why the depth cannot be believed, by what ``others``, the best to compare with first, saw; None if it can."""
    if not others:
        return "no_overlap"
    points = measured.surface()
    ratios = np.stack([_ratios(points, other) for other in others])
    compared = np.count_nonzero((ratios > 0).any(axis=0))
    if compared < COMPARED_MIN * measured.depth.size:
        return "no_overlap"

    def share(factor: float) -> float:
        return float(np.count_nonzero((np.abs(ratios / factor - 1) < TOLERANCE).any(axis=0))) / compared

    if share(1.0) < CONFIRMED_MIN:
        return "wrong_scale" if share(float(np.median(ratios[ratios > 0]))) >= CONFIRMED_MIN else "no_depth"
    correlations = [_correlation(measured, points, factor, others[0].view) for factor in FACTORS]
    best = max(correlations)
    is_wrong = best >= CORRELATION_MIN and best > correlations[0] + CORRELATION_GAIN
    return "wrong_scale" if is_wrong else None


def _ratios(points: Floats, other: Measured) -> Floats:
    """(N,) what ``other`` measured where it should see ``points`` (N, 3), as a multiple of their depth; 0: nothing."""
    places, ahead, within = _project(points, other.view)
    found = np.zeros(len(points))
    found[within] = other.depth.ravel()[places] / ahead[within]
    return found


def _correlation(measured: Measured, points: Floats, factor: float, other: View) -> float:
    """Of what the two images show of ``points``, were they ``factor`` times as far away; -1 without overlap."""
    places, _, within = _project(measured.view.position + factor * (points - measured.view.position), other)
    here = measured.view.grey[measured.depth > 0][within].astype(float)
    there = other.grey.ravel()[places].astype(float)
    if here.size < COMPARED_MIN * measured.depth.size or not (here.any() and there.any()):
        return -1.0
    here -= here.mean()
    there -= there.mean()
    power = float(np.sqrt((here @ here) * (there @ there)))
    return float(here @ there) / power if power > 0 else -1.0


def _project(points: Floats, view: View) -> tuple[NDArray[np.int64], Floats, NDArray[np.bool_]]:
    """Pixels in which ``view`` shows those of ``points`` (N, 3) that it does, numbered row by row; the depth of all
    (N,), and which these are (N,)."""
    height, width = view.grey.shape
    seen = (points - view.position) @ view.rotation @ view.calibration.T
    ahead = np.maximum(seen[:, 2], NEAREST_M)
    columns, rows = (np.rint(seen[:, axis] / ahead).clip(-1, size) for axis, size in ((0, width), (1, height)))
    within = (seen[:, 2] > NEAREST_M) & (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    return (rows[within] * width + columns[within]).astype(np.int64), ahead, within
