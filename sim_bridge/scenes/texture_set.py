"""Textures as the rasteriser reads them: every mip level of every image in one flat array of packed texels.

One array and two small tables keep the inner loop free of Python objects, and make the pictures' bytes easy to
cache and to hash.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MAX_SIDE = 4096
"""Larger images are reduced; 4096 texels over a 7 m wall are finer than any camera here sees."""
MAX_LEVELS = MAX_SIDE.bit_length()
_PACKING = np.array([1, 1 << 8, 1 << 16], dtype=np.uint32)


@dataclass(frozen=True, slots=True)
class TextureSet:
    """Mip pyramids of K textures whose sides are powers of two, so that repeating them is a bit mask."""

    texels: NDArray[np.uint32]
    """[N], ``red | green << 8 | blue << 16``, row by row from the top, levels and textures one after another."""
    offsets: NDArray[np.int64]
    """[K, MAX_LEVELS], where a level starts in ``texels``; levels past the last repeat the last."""
    sizes: NDArray[np.int32]
    """[K, 3]: width, height and number of levels; level l is ``max(1, width >> l) x max(1, height >> l)``."""


def with_contrast(image: NDArray[np.uint8], contrast: float) -> NDArray[np.uint8]:
    """The image [H, W, 3] with each texel's difference from its mean colour times ``contrast``; 1 leaves it alone."""
    if contrast == 1.0:
        return image
    mean = image.mean(axis=(0, 1))
    flattened: NDArray[np.uint8] = np.clip(np.rint(mean + contrast * (image - mean)), 0, 255).astype(np.uint8)
    return flattened


def build_texture_set(images: Sequence[NDArray[np.uint8]]) -> TextureSet:
    """Pack images [H, W, 3] (any size) with their mip levels (box filter)."""
    texels: list[NDArray[np.uint32]] = []
    offsets = np.zeros((len(images), MAX_LEVELS), dtype=np.int64)
    sizes = np.zeros((len(images), 3), dtype=np.int32)
    start = 0
    for index, image in enumerate(images):
        levels = _pyramid(_to_power_of_two(image))
        height, width = levels[0].shape[:2]
        sizes[index] = width, height, len(levels)
        for level, pixels in enumerate(levels):
            packed = pixels.astype(np.uint32)
            texels.append((packed @ _PACKING).ravel())
            offsets[index, level:] = start
            start += texels[-1].size
    return TextureSet(np.concatenate(texels), offsets, sizes)


def _pyramid(image: NDArray[np.uint8]) -> list[NDArray[np.uint8]]:
    levels = [image]
    level = image.astype(np.float32)
    while level.shape[0] > 1 or level.shape[1] > 1:
        if level.shape[0] > 1:
            level = (level[0::2] + level[1::2]) * np.float32(0.5)
        if level.shape[1] > 1:
            level = (level[:, 0::2] + level[:, 1::2]) * np.float32(0.5)
        levels.append(np.rint(level).astype(np.uint8))
    return levels


def _to_power_of_two(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = (min(MAX_SIDE, 1 << (side - 1).bit_length()) for side in image.shape[:2])
    if (height, width) == image.shape[:2]:
        return image
    from PIL import Image

    return np.asarray(Image.fromarray(image).resize((width, height), Image.Resampling.LANCZOS))
