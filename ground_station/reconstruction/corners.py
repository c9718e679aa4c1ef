"""Corners of an image: small places that can be found again in another one, spread evenly over it."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

WINDOW: Final = 7
"""Side, in pixels, of the window whose gradients are judged."""
STRENGTH_MIN: Final = 12.0
"""Least mean square of the gradient across the weaker direction: six times what camera noise of 2 grey levels gives."""


def find_corners(grey: NDArray[np.float32], cell: int, margin: int) -> NDArray[np.float32]:
    """(N, 2) column and row of the strongest corner in each square of ``cell`` pixels that has one.

    None lies within ``margin`` pixels of the border. The strength is the smaller eigenvalue of the mean outer product
    of the gradients (Shi and Tomasi, "Good features to track", 1994).
    """
    across, down = np.zeros_like(grey), np.zeros_like(grey)
    across[:, 1:-1] = (grey[:, 2:] - grey[:, :-2]) / 2
    down[1:-1] = (grey[2:] - grey[:-2]) / 2
    a, b, c = (uniform_filter(product, WINDOW) for product in (across * across, across * down, down * down))
    strength = (a + c) / 2 - np.sqrt(((a - c) / 2) ** 2 + b * b)
    inner = np.zeros_like(strength)
    inner[margin:-margin, margin:-margin] = strength[margin:-margin, margin:-margin]
    rows, columns = -(-grey.shape[0] // cell), -(-grey.shape[1] // cell)
    padded = np.zeros((rows * cell, columns * cell), np.float32)
    padded[: grey.shape[0], : grey.shape[1]] = inner
    cells = padded.reshape(rows, cell, columns, cell).swapaxes(1, 2).reshape(rows * columns, cell * cell)
    best = cells.argmax(axis=1)
    number = np.flatnonzero(cells[np.arange(len(cells)), best] > STRENGTH_MIN)
    row, column = np.divmod(best[number], cell)
    corners = np.column_stack([number % columns * cell + column, number // columns * cell + row])
    return corners.astype(np.float32)
