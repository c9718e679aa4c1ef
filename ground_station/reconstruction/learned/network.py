"""The network: photographs to features, features to a volume, the volume to signed distance and occupancy.

Two levels as in NeuralRecon, without its third and its sparse convolutions: the coarse one is a dense U-Net, the fine
one is decided voxel by voxel and only where the coarse one sees a surface.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor, nn
from torch.nn import functional

from ground_station.reconstruction.learned.fragment import COARSE, FINE_M, NEAREST_M

ARCHITECTURE: Final = "dense-2-level/3"
"""Changes with everything that makes old weights useless, also with the meaning of inputs and outputs."""

IMAGE_WIDTH: Final = 256
"""Pixels; photographs are brought to this width, and to a height that is a multiple of `IMAGE_STEP`."""
IMAGE_STEP: Final = 8
"""The image net halves three times."""
SHOWN: Final = 4
"""Colours and local contrast."""
QUARTER: Final = 20
"""Features of the quarter-size map, which fill the coarse volume ..."""
HALF: Final = 12
"""... and of the half-size map, which refine; with what is shown in both."""
IMAGE_WIDTHS: Final = (24, 48, 64)
VOLUME_WIDTHS: Final = (48, 96, 160)
REFINED_WIDTH: Final = 96
GROUP: Final = 8
"""Channels that are normalised together; divides all widths."""
CONTRAST_PX: Final = 9
"""Local contrast is measured over squares of so many pixels ..."""
CONTRAST_FLOOR: Final = 0.02
"""... and not amplified below about this, the camera's noise; 1 is white."""
LUMA: Final = (0.299, 0.587, 0.114)
DEPTH_SCALE_M: Final = 3.0
"""Brings depth to about 1."""
VARIANCE_FLOOR: Final = 1e-4
"""Under the root of the variance over views, whose slope would be infinite at 0."""


@dataclass(frozen=True, slots=True)
class Features:
    """Of V photographs."""

    quarter: Tensor
    """(V, QUARTER, h / 4, w / 4)"""
    half: Tensor
    """(V, HALF, h / 2, w / 2)"""


@dataclass(frozen=True, slots=True)
class Coarse:
    hidden: Tensor
    """(1, C, X, Y, Z)"""
    distance: Tensor
    """(X, Y, Z) in [-1, 1]: signed distance over `fragment.REACH_M`, positive in front."""
    occupied: Tensor
    """(X, Y, Z), logit of being within reach of a surface."""
    seen: Tensor
    """(X, Y, Z), number of views."""


@dataclass(frozen=True, slots=True)
class Refined:
    """Of P fine voxels."""

    distance: Tensor
    """(P,) as in `Coarse`."""
    occupied: Tensor
    """(P,)"""
    seen: Tensor
    """(P,)"""


def _norm(channels: int) -> nn.GroupNorm:
    """The same in training and in flight, whatever the number of views; of an image it takes its contrast away."""
    return nn.GroupNorm(channels // GROUP, channels)


def _flat(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), _norm(outputs), nn.ReLU(inplace=True))


def _solid(inputs: int, outputs: int, stride: int = 1, size: int = 3) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv3d(inputs, outputs, size, stride, size // 2, bias=False), _norm(outputs), nn.ReLU(inplace=True)
    )


class ImageNet(nn.Module):
    """A small feature pyramid."""

    def __init__(self) -> None:
        super().__init__()
        first, second, third = IMAGE_WIDTHS
        self.down1 = nn.Sequential(_flat(SHOWN, first, 2), _flat(first, first))
        self.down2 = nn.Sequential(_flat(first, second, 2), _flat(second, second))
        self.down3 = nn.Sequential(_flat(second, third, 2), _flat(third, third))
        self.from3 = nn.Conv2d(third, second, 1)
        self.to_quarter = nn.Conv2d(second, QUARTER - SHOWN, 3, 1, 1)
        self.from2 = nn.Conv2d(second, first, 1)
        self.to_half = nn.Conv2d(first, HALF - SHOWN, 3, 1, 1)

    def forward(self, images: Tensor) -> Features:
        """``images`` (V, 3, H, W) in [0, 1], both sides multiples of `IMAGE_STEP`."""
        shown = torch.cat([2 * images - 1, local_contrast(images)], dim=1)
        half = self.down1(shown)
        quarter = self.down2(half)
        quarter = quarter + functional.interpolate(self.from3(self.down3(quarter)), scale_factor=2.0)
        half = half + functional.interpolate(self.from2(quarter), scale_factor=2.0)
        # What is seen is passed on beside what is learnt: where views agree on it, there may be a surface.
        return Features(
            torch.cat([self.to_quarter(quarter), functional.avg_pool2d(shown, 4)], dim=1),
            torch.cat([self.to_half(half), functional.avg_pool2d(shown, 2)], dim=1),
        )


def local_contrast(images: Tensor) -> Tensor:
    """(V, 1, H, W): brightness against its surroundings in standard deviations: faint texture looks like strong."""
    grey = (images * images.new_tensor(LUMA).view(1, 3, 1, 1)).sum(dim=1, keepdim=True)

    def mean(values: Tensor) -> Tensor:
        return functional.avg_pool2d(values, CONTRAST_PX, 1, CONTRAST_PX // 2, count_include_pad=False)

    around = mean(grey)
    variance = (mean(grey * grey) - around * around).clamp_min(0)
    return (grey - around) / (variance + CONTRAST_FLOOR**2).sqrt()


class VolumeNet(nn.Module):
    """A U-Net of three sizes."""

    def __init__(self) -> None:
        super().__init__()
        first, second, third = VOLUME_WIDTHS
        self.enter = nn.Sequential(_solid(2 * QUARTER + 2, first, size=1), _solid(first, first))
        self.down1 = nn.Sequential(_solid(first, second, 2), _solid(second, second))
        self.down2 = nn.Sequential(_solid(second, third, 2), _solid(third, third))
        self.from2 = nn.Conv3d(third, second, 1)
        self.up1 = _solid(second, second)
        self.from1 = nn.Conv3d(second, first, 1)
        self.up0 = _solid(first, first)
        self.heads = nn.Conv3d(first, 2, 1)

    def forward(self, volume: Tensor) -> tuple[Tensor, Tensor]:
        large = self.enter(volume)
        middle = self.down1(large)
        small = self.down2(middle)
        middle = self.up1(middle + functional.interpolate(self.from2(small), scale_factor=2.0))
        hidden = self.up0(large + functional.interpolate(self.from1(middle), scale_factor=2.0))
        return hidden, self.heads(hidden)


class Network(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.image_net = ImageNet()
        self.volume_net = VolumeNet()
        self.refiner = nn.Sequential(
            nn.Linear(VOLUME_WIDTHS[0] + 2 * HALF + 3, REFINED_WIDTH),
            nn.ReLU(inplace=True),
            nn.Linear(REFINED_WIDTH, REFINED_WIDTH),
            nn.ReLU(inplace=True),
            nn.Linear(REFINED_WIDTH, 2),
        )

    def coarse(self, features: Features, projections: Tensor, corner: Tensor, shape: tuple[int, int, int]) -> Coarse:
        """``projections`` (V, 3, 4) as of `fragment.projection`; ``corner`` (3,) m, the first fine voxel.

        ``shape``: coarse voxels, multiples of 4.
        """
        axes = [torch.arange(size, dtype=torch.float32) * COARSE + (COARSE - 1) / 2 for size in shape]
        places = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3)
        mean, spread, seen, depth = gather(features.quarter, projections, corner + FINE_M * places)
        share = seen / len(projections)
        volume = torch.cat([mean, spread, share[None], depth[None] / DEPTH_SCALE_M]).reshape(1, -1, *shape)
        hidden, heads = self.volume_net(volume)
        return Coarse(hidden, torch.tanh(heads[0, 0].float()), heads[0, 1].float(), seen.reshape(shape))

    def refine(
        self, features: Features, projections: Tensor, corner: Tensor, coarse: Coarse, voxels: Tensor
    ) -> Refined:
        """``voxels`` (P, 3): fine voxels of the window."""
        places = voxels.to(torch.float32)
        mean, spread, seen, _ = gather(features.half, projections, corner + FINE_M * places)
        around = torch.cat([coarse.hidden.float(), torch.stack([coarse.distance, coarse.occupied])[None]], dim=1)
        size = places.new_tensor(around.shape[2:])
        grid = 2 * (places + 0.5) / (COARSE * size) - 1
        near = functional.grid_sample(
            around, grid.flip(-1)[None, :, None, None], padding_mode="border", align_corners=False
        ).reshape(around.shape[1], -1)
        share = seen / len(projections)
        heads = self.refiner(torch.cat([near, mean, spread, share[None]]).T).float()
        # What the coarse level says is corrected, not said again.
        coarse_distance = near[-2].clamp(-0.99, 0.99)
        distance = torch.tanh(heads[:, 0] + torch.atanh(coarse_distance))
        return Refined(distance, heads[:, 1] + near[-1], seen)


def gather(maps: Tensor, projections: Tensor, places: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Features of the views that see each of P places: mean and standard deviation (C, P), count, mean depth (P,)."""
    with torch.autocast("cpu", enabled=False):  # places in half precision would be pixels off
        images = torch.einsum("vij,pj->vpi", projections[..., :3], places) + projections[:, None, :, 3]
        depth = images[..., 2]
        pixels = images[..., :2] / depth.clamp_min(NEAREST_M)[..., None]
        valid = (depth > NEAREST_M) & ((pixels >= 0) & (pixels <= 1)).all(dim=-1)
        values = functional.grid_sample(
            maps.float(), (2 * pixels - 1)[:, None], padding_mode="border", align_corners=False
        )[:, :, 0]
        weight = valid.to(torch.float32)
        seen = weight.sum(dim=0)
        share = weight / seen.clamp_min(1)
        mean = (values * share[:, None]).sum(dim=0)
        variance = (((values - mean) ** 2) * share[:, None]).sum(dim=0)
        return mean, (variance + VARIANCE_FLOOR).sqrt(), seen, (depth * share).sum(dim=0)
