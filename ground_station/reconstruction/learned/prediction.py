"""One fragment through the network: photographs' features in, a block of signed distance, weight and colour out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ground_station.reconstruction.learned.fragment import COARSE, FINE_M, REACH_M, VIEWS, Window
from ground_station.reconstruction.learned.network import IMAGE_STEP, IMAGE_WIDTH, Features, Network, gather
from protocol.geometry import Floats

REFINED_FROM: Final = 0.25
"""Probability of a surface from which a coarse voxel is refined: to refine too much only takes time."""
SURFACE_FROM: Final = 0.5
"""Probability from which a voxel's distance is believed; below it, a voxel in front is taken for empty."""
VIEWS_SEEN: Final = 2
"""Views that must see a voxel: one alone says nothing of depth."""


@dataclass(frozen=True, slots=True, eq=False)
class Photograph:
    """What is kept of one, so that all fragments it is part of share its features."""

    image: Tensor
    """(3, H, W) in [0, 1]."""
    features: Features
    """Of this one alone."""

    @property
    def size_bytes(self) -> int:
        return int(self.image.nbytes + self.features.quarter.nbytes + self.features.half.nbytes)


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Of fine voxels (X, Y, Z), for `fusion.Volume.blend`."""

    distance: NDArray[np.float32]
    """m."""
    weight: NDArray[np.float32]
    """Up to 1: how sure the network is, times the share of the views that a fragment may have."""
    color: NDArray[np.uint8]
    surface: bool
    """Whether there is any surface in it."""


class Predictor:
    """Same photographs, same block: one thread, no dropout, no chance."""

    def __init__(self, network: Network) -> None:
        torch.set_num_threads(1)  # sums hang on the number of threads
        self._network = network.eval()

    @staticmethod
    def size(width: int, height: int) -> tuple[int, int]:
        """Width and height to which a photograph of this size is brought before it is given to `look`."""
        return IMAGE_WIDTH, max(1, round(IMAGE_WIDTH * height / width / IMAGE_STEP)) * IMAGE_STEP

    def look(self, image: NDArray[np.uint8]) -> Photograph:
        """``image`` (H, W, 3) of a `size`."""
        with torch.inference_mode():
            planes = torch.from_numpy(image.transpose(2, 0, 1).astype(np.float32) / np.float32(255))
            return Photograph(planes, self._network.image_net(planes[None]))

    def predict(self, photographs: list[Photograph], projections: Floats, corner: Floats, window: Window) -> Block:
        """``projections`` (V, 3, 4) from the world, as of `fragment.projection`; ``corner`` (3,) m of the window."""
        to_window = np.eye(4)
        to_window[:3, 3] = corner  # near the origin float32 is finer
        with torch.inference_mode():
            return self._predict(photographs, torch.from_numpy((projections @ to_window).astype(np.float32)), window)

    def _predict(self, photographs: list[Photograph], projections: Tensor, window: Window) -> Block:
        features = Features(
            torch.cat([each.features.quarter for each in photographs]),
            torch.cat([each.features.half for each in photographs]),
        )
        corner = torch.zeros(3)
        coarse = self._network.coarse(features, projections, corner, window.coarse)
        probability = torch.sigmoid(coarse.occupied)
        empty = (probability < SURFACE_FROM) & (coarse.distance > 0) & (coarse.seen >= VIEWS_SEEN)
        distance = torch.full(window.fine, REACH_M)
        weight = _spread(empty * (1 - probability) * coarse.seen / VIEWS)
        color = torch.zeros((*window.fine, 3), dtype=torch.uint8)

        parents = ((probability >= REFINED_FROM) & (coarse.seen >= VIEWS_SEEN)).nonzero()
        if not len(parents):
            return Block(distance.numpy(), weight.numpy(), color.numpy(), surface=False)
        within = torch.cartesian_prod(*[torch.arange(COARSE)] * 3)
        voxels = (COARSE * parents[:, None] + within).reshape(-1, 3)
        refined = self._network.refine(features, projections, corner, coarse, voxels)
        sure = torch.sigmoid(refined.occupied)
        surface = (sure >= SURFACE_FROM) & (refined.seen >= VIEWS_SEEN)
        clear = (sure < SURFACE_FROM) & (refined.seen >= VIEWS_SEEN) & (refined.distance > 0)
        trust = torch.where(surface, sure, torch.where(clear, 1 - sure, 0.0))
        place = tuple(voxels.T)
        distance[place] = torch.where(surface, REACH_M * refined.distance, REACH_M)
        weight[place] = trust * refined.seen / VIEWS
        shown = voxels[surface]
        images = torch.stack([each.image for each in photographs])
        mean, _, _, _ = gather(images, projections, corner + FINE_M * shown)
        color[tuple(shown.T)] = (255 * mean.T).round().clamp(1, 255).to(torch.uint8)  # black would be no colour
        return Block(distance.numpy(), weight.numpy(), color.numpy(), bool(surface.any()))


def _spread(coarse: Tensor) -> Tensor:
    """Each coarse voxel's value in all of its fine ones."""
    for axis in range(3):
        coarse = coarse.repeat_interleave(COARSE, dim=axis)
    return coarse
