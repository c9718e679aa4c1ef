"""Depth of one view on a graphics card: the same sweep and aggregation as on the processor, whole volumes at a time.

On a processor this takes ten times as long as `plane_sweep` and `semi_global`, whose results it has but for rounding.
Torch is imported with this module, so only missions that ask for it load it: see `depth_map.make_estimator`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from ground_station.reconstruction.depth_map import DepthMap, depth_map_of, inverse_depths_of
from ground_station.reconstruction.depth_range import DepthRange
from ground_station.reconstruction.plane_sweep import COST_MAX, NOISE_VARIANCE, PIXELS, RADIUS, WINDOW, plane_homography
from ground_station.reconstruction.semi_global import BORDER, CONTRAST, JUMP_PENALTY, STEP_PENALTY, Disparity
from ground_station.reconstruction.views import View
from protocol.errors import ReconstructionError
from protocol.map_settings import Reconstruction

BEHIND: Final = 1e-6
"""Least scale of a homogeneous pixel that lies before the camera."""
EDGE_PX: Final = 1.001
"""What a source sees ends so far before its last row and column: a pixel is interpolated from four."""


def has_card() -> bool:
    """Whether torch can use a graphics card here."""
    return bool(torch.cuda.is_available())


class TorchDepthEstimator:
    """As `depth_map.DepthEstimator`; may be called from several threads, which share the card."""

    def __init__(self, settings: Reconstruction, device: str = "cuda") -> None:
        """Raises `ReconstructionError` if torch cannot use ``device``."""
        if device == "cuda" and not has_card():
            raise ReconstructionError(
                f'reconstruction.device "cuda": torch {torch.__version__} sees no graphics card it can use; '
                f"covrecon doctor tells more"
            )
        self._settings, self._device = settings, torch.device(device)

    def estimate(self, view: View, sources: Sequence[View], span: DepthRange) -> DepthMap:
        """Depth of ``view`` between ``span.nearest`` and ``span.farthest``, within the mission's limits."""
        inverse_depths = inverse_depths_of(span, self._settings)
        with torch.inference_mode():
            costs = self.costs(view, sources, inverse_depths)
            plane, score = aggregate(costs, self._tensor(view.grey))
        return depth_map_of(Disparity(plane.cpu().numpy(), score.cpu().numpy()), inverse_depths)

    def costs(self, reference: View, sources: Sequence[View], inverse_depths: NDArray[np.float32]) -> Tensor:
        """(H, W, D) as of `plane_sweep.PlaneSweep.costs`, float."""
        homographies = [plane_homography(reference, source) for source in sources]
        turns = self._tensor(np.stack([turn for turn, _ in homographies]))
        shifts = self._tensor(np.stack([shift for _, shift in homographies]))
        images = self._tensor(np.stack([source.grey for source in sources])) - 128
        image = self._tensor(reference.grey) - 128
        warped, inside = _warp(images, turns, shifts, self._tensor(inverse_depths))
        score = _correlation(image, warped)
        inner = inside[:, :, RADIUS:-RADIUS, RADIUS:-RADIUS]
        costs = torch.full((*image.shape, len(inverse_depths)), float(COST_MAX), device=self._device)
        costs[RADIUS:-RADIUS, RADIUS:-RADIUS] = _rate(score, inner).permute(1, 2, 0)
        return costs

    def _tensor(self, array: NDArray[np.generic]) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array, np.float32)).to(self._device)


def _warp(images: Tensor, turns: Tensor, shifts: Tensor, inverse_depths: Tensor) -> tuple[Tensor, Tensor]:
    """``images`` (S, H, W) as the reference would see them on each plane (S, D, H, W), and where it does (bool)."""
    sources, height, width = images.shape
    rows, columns = torch.meshgrid(
        torch.arange(height, device=images.device), torch.arange(width, device=images.device), indexing="ij"
    )
    pixels = torch.stack([columns, rows, torch.ones_like(rows)]).to(images.dtype)
    seen = torch.einsum("sij,jhw->sihw", turns, pixels)[:, :, None]
    u, v, scale = (seen + shifts[:, :, None, None, None] * inverse_depths[:, None, None]).unbind(1)
    inverse = 1 / scale.clamp(min=BEHIND)
    u, v = u * inverse, v * inverse
    across, down = u.clamp(0, width - EDGE_PX), v.clamp(0, height - EDGE_PX)
    left, top = across.floor(), down.floor()
    place = (top * width + left).long().reshape(sources, -1)
    flat = images.reshape(sources, -1)
    upper_left, upper_right, lower_left, lower_right = (
        flat.gather(1, place + step).reshape(u.shape) for step in (0, 1, width, width + 1)
    )
    across_share, down_share = across - left, down - top
    upper = upper_left + across_share * (upper_right - upper_left)
    lower = lower_left + across_share * (lower_right - lower_left)
    inside = (across == u) & (down == v) & (scale > BEHIND)
    return upper + down_share * (lower - upper), inside


def _box(volume: Tensor) -> Tensor:
    """Sums over whole windows of the last two axes."""
    flat = volume.reshape(-1, 1, *volume.shape[-2:])
    sums = functional.avg_pool2d(flat, WINDOW, stride=1, divisor_override=1)
    return sums.reshape(*volume.shape[:-2], *sums.shape[-2:])


def _correlation(image: Tensor, warped: Tensor) -> Tensor:
    """(S, D, H', W') of each whole window of ``image`` (H, W) with ``warped`` (S, D, H, W)."""
    noise = NOISE_VARIANCE * PIXELS * PIXELS
    total, other_total = _box(image), _box(warped)
    spread = (PIXELS * _box(image * image) - total * total).clamp(min=0) + noise
    other_spread = (PIXELS * _box(warped * warped) - other_total * other_total).clamp(min=0) + noise
    covariance = PIXELS * _box(image * warped) - total * other_total
    return covariance * torch.rsqrt(spread) * torch.rsqrt(other_spread)


def _rate(score: Tensor, inside: Tensor) -> Tensor:
    """(D, H', W') cost of the mean score, without the worst source where three or more see the pixel."""
    count = inside.sum(0)
    total = torch.where(inside, score, 0.0).sum(0)
    worst = torch.where(inside, score, torch.inf).amin(0)
    drop = count > 2
    mean = ((total - torch.where(drop, worst, 0.0)) / (count - drop.to(count.dtype)).clamp(min=1)).clamp(min=0)
    return (COST_MAX * (1 - mean) + 0.5).clamp(max=COST_MAX).floor()


def aggregate(costs: Tensor, image: Tensor) -> tuple[Tensor, Tensor]:
    """Fractional plane and score, (H, W) each, as of `semi_global.SemiGlobal.aggregate`."""
    total = _paths(costs, image) + _paths(costs.transpose(0, 1), image.T).transpose(0, 1)
    planes = total.shape[2]
    best = total.argmin(2, keepdim=True)
    inner = ((best > 0) & (best < planes - 1)).squeeze(2)
    middle = best.clamp(1, planes - 2)
    before, here, after = (total.gather(2, middle + step).squeeze(2) for step in (-1, 0, 1))
    bend = before - 2 * here + after
    shift = torch.where(inner & (bend > 0), 0.5 * (before - after) / bend.clamp(min=torch.finfo().tiny), 0.0)
    score = torch.where(inner, 1 - costs.gather(2, best).squeeze(2) / COST_MAX, 0.0)
    return best.squeeze(2) + shift, score


def _paths(costs: Tensor, image: Tensor) -> Tensor:
    """Sum (H, W, D) of the aggregated costs along the rows, one way and the other: both are walked at once."""
    jump = JUMP_PENALTY / (1 + (image[:, 1:] - image[:, :-1]).abs() / CONTRAST)
    both = torch.stack([costs, costs.flip(1)]).permute(2, 0, 1, 3).contiguous()  # (W, 2, H, D)
    jumps = torch.stack([jump, jump.flip(1)]).permute(2, 0, 1)[..., None].contiguous()
    path = torch.empty_like(both)
    path[0] = both[0]
    for place in range(1, len(both)):
        previous = path[place - 1]
        lowest = previous.amin(2, keepdim=True)
        bordered = functional.pad(previous, (1, 1), value=BORDER)
        beside = torch.minimum(bordered[..., :-2], bordered[..., 2:]) + STEP_PENALTY
        best = torch.minimum(torch.minimum(previous, beside), lowest + jumps[place - 1])
        path[place] = both[place] + best - lowest
    there, back = path.permute(1, 2, 0, 3)
    return there + back.flip(1)
