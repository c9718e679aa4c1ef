"""What is kept of a keyframe, a small grey image and where it was taken, and whether it is worth using."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from protocol.geometry import Floats, Intrinsics

CONTRAST_MIN: Final = 2.0
"""Standard deviation in grey levels under which an image shows nothing: lens covered, night, a bare wall."""
SHARPNESS_MIN: Final = 0.32
"""Least mean step between neighbouring pixels, as a share of the mean step over `BLUR_SPAN` pixels: contrast cancels.
The living room has 0.41 to 0.58, motion blur by 4 pixels of the sweep leaves 0.30 to 0.36, any blur at least 0.25."""
BLUR_SPAN: Final = 4
LUMA: Final = (0.299, 0.587, 0.114)
"""ITU-R BT.601 weights of red, green, blue; JPEG's own."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    grey: NDArray[np.uint8]
    """(H, W), the size of the sweep."""
    position: Floats
    """(3,) m, world."""
    rotation: Floats
    """(3, 3), camera to world."""
    intrinsics: Intrinsics
    """Of ``grey``."""

    @property
    def calibration(self) -> Floats:
        """(3, 3): camera frame to homogeneous pixel index, whose integers are pixel centres."""
        camera = self.intrinsics
        return np.array([[camera.fx, 0.0, camera.cx - 0.5], [0.0, camera.fy, camera.cy - 0.5], [0.0, 0.0, 1.0]])

    @property
    def optical_axis(self) -> Floats:
        """(3,), unit, world."""
        return self.rotation[:, 2]


def shrink(image: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """(height, width, 3): mean over the area that each new pixel covers of ``image`` (H, W, 3)."""
    small = np.empty((height, width, 3), np.uint8)
    _shrink(np.ascontiguousarray(image), small, np.empty(image.shape[1] * 3, np.float32))
    return small


def to_grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(H, W) brightness of ``image`` (H, W, 3)."""
    return np.rint(image.astype(np.float32) @ np.array(LUMA, np.float32)).astype(np.uint8)


def contrast(grey: NDArray[np.uint8]) -> float:
    return float(grey.std())


def sharpness(grey: NDArray[np.uint8]) -> float:
    """Mean step between neighbours over mean step across `BLUR_SPAN` pixels, in the blurrier of the two directions."""
    levels = grey.astype(np.int16)
    ratios = []
    for lines in (levels, levels.T):
        near = np.abs(lines[1:] - lines[:-1]).mean()
        far = np.abs(lines[BLUR_SPAN:] - lines[:-BLUR_SPAN]).mean()
        ratios.append(near / far if far > 0 else 1.0)
    return float(min(ratios))


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _shrink(image: NDArray[np.uint8], small: NDArray[np.uint8], line: NDArray[np.float32]) -> None:
    height, width = image.shape[:2]
    rows, columns = small.shape[:2]
    tall, wide = height / rows, width / columns
    for row in range(rows):
        top, bottom = row * tall, (row + 1) * tall
        line[:] = np.float32(0)
        for y in range(int(top), min(int(np.ceil(bottom)), height)):
            share = np.float32((min(y + 1.0, bottom) - max(float(y), top)) / tall)
            source = image[y].reshape(width * 3)
            for place in range(width * 3):
                line[place] += share * np.float32(np.int32(source[place]))
        for column in range(columns):
            left, right = column * wide, (column + 1) * wide
            red, green, blue = np.float32(0.5), np.float32(0.5), np.float32(0.5)
            for x in range(int(left), min(int(np.ceil(right)), width)):
                share = np.float32((min(x + 1.0, right) - max(float(x), left)) / wide)
                red += share * line[3 * x]
                green += share * line[3 * x + 1]
                blue += share * line[3 * x + 2]
            small[row, column, 0] = np.uint8(min(red, np.float32(255)))
            small[row, column, 1] = np.uint8(min(green, np.float32(255)))
            small[row, column, 2] = np.uint8(min(blue, np.float32(255)))
