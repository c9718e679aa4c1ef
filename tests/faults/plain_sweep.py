"""The plane sweep in its plain form, whole images in NumPy: what the compiled one is measured and checked against."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ground_station.reconstruction.plane_sweep import COST_MAX, NOISE_VARIANCE, PIXELS, RADIUS, WINDOW, plane_homography
from ground_station.reconstruction.views import View
from protocol.geometry import Floats


def plain_costs(reference: View, sources: Sequence[View], inverse_depths: NDArray[np.float32]) -> NDArray[np.uint8]:
    """As `PlaneSweep.costs`."""
    image = reference.grey.astype(float) - 128
    mean, deviation = _moments(image)
    costs = np.full((*image.shape, inverse_depths.size), COST_MAX, np.uint8)
    inner = slice(RADIUS, -RADIUS)
    for plane, inverse_depth in enumerate(inverse_depths):
        scores, seen = [], []
        for source in sources:
            turn, shift = plane_homography(reference, source)
            warped, inside = _warp(source.grey.astype(float) - 128, turn, shift * inverse_depth)
            other_mean, other_deviation = _moments(warped)
            covariance = _box(image * warped) / PIXELS - mean * other_mean
            scores.append(covariance / (deviation * other_deviation))
            seen.append(inside[inner, inner])
        costs[inner, inner, plane] = _rate(np.array(scores), np.array(seen))
    return costs


def _rate(scores: Floats, seen: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Of the mean, without the worst where three or more see the pixel."""
    count = seen.sum(axis=0)
    total = np.where(seen, scores, 0.0).sum(axis=0)
    worst = np.where(seen, scores, np.inf).min(axis=0)
    drop = count > 2
    mean = np.maximum((total - np.where(drop, worst, 0.0)) / np.maximum(count - drop, 1), 0.0)
    return np.minimum(COST_MAX * (1 - mean) + 0.5, COST_MAX).astype(np.uint8)


def _box(image: Floats) -> Floats:
    """Sums over whole windows."""
    sums = np.pad(image, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    return sums[WINDOW:, WINDOW:] - sums[:-WINDOW, WINDOW:] - sums[WINDOW:, :-WINDOW] + sums[:-WINDOW, :-WINDOW]


def _moments(image: Floats) -> tuple[Floats, Floats]:
    """Mean and standard deviation of each window, the latter with the noise's."""
    mean = _box(image) / PIXELS
    return mean, np.sqrt(np.maximum(_box(image * image) / PIXELS - mean * mean, 0.0) + NOISE_VARIANCE)


def _warp(image: Floats, turn: Floats, shift: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """``image`` as the reference would see it on a plane, and where it does."""
    height, width = image.shape
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    u, v, scale = (
        np.einsum("ij,jhw->ihw", turn, np.stack([columns, rows, np.ones_like(columns)])) + shift[:, None, None]
    )
    ahead = scale > 1e-6
    u, v = u / np.maximum(scale, 1e-6), v / np.maximum(scale, 1e-6)
    across, down = np.clip(u, 0, width - 1.001), np.clip(v, 0, height - 1.001)
    left, top = across.astype(int), down.astype(int)
    across_share, down_share = across - left, down - top
    upper = image[top, left] * (1 - across_share) + image[top, left + 1] * across_share
    lower = image[top + 1, left] * (1 - across_share) + image[top + 1, left + 1] * across_share
    return upper * (1 - down_share) + lower * down_share, ahead & (across == u) & (down == v)
