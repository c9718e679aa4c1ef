"""What a depth camera measured, as it travels with a keyframe: a PNG of 16-bit millimetres, without loss.

Depth is along the optical axis; 0 stands for unknown. The image shows what the keyframe's own shows, in fewer pixels.
"""

from __future__ import annotations

import io
import math

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from protocol.errors import MessageError

FARTHEST_M = 65.535
"""What 16 bits of millimetres can say; farther is unknown."""
SIDE_MAX_PX = 2048
"""Twice the widest that a mission may ask for."""
_MODES = ("I;16", "I;16B", "I")
"""What Pillow calls a PNG of 16-bit greys, by version."""


def encode_depth(depth: NDArray[np.float32]) -> bytes:
    """Of ``depth`` (H, W) m; what is not finite, not positive or too far is unknown."""
    known = np.isfinite(depth) & (depth > 0) & (depth <= FARTHEST_M)
    millimetres = np.rint(np.where(known, depth, 0) * 1000).astype(np.uint16)
    content = io.BytesIO()
    Image.fromarray(millimetres).save(content, "PNG")
    return content.getvalue()


def decode_depth(content: bytes, width: int, height: int) -> NDArray[np.float32]:
    """(h, w) m, 0 where unknown, of a keyframe whose image has ``width`` x ``height`` pixels.

    Raises:
        MessageError: it is no such PNG, or not of the image's shape.
    """
    try:
        with Image.open(io.BytesIO(content), formats=["PNG"]) as image:
            columns, rows = image.size
            if image.mode not in _MODES:
                raise MessageError(f"depth image has pixels of kind {image.mode}, not 16-bit greys")
            if max(columns, rows) > SIDE_MAX_PX or not math.isclose(rows, columns * height / width, abs_tol=1.0):
                raise MessageError(f"depth image of {columns} x {rows} pixels does not fit {width} x {height}")
            millimetres = np.asarray(image)
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError) as error:
        raise MessageError(f"depth image cannot be read: {error}") from error
    return millimetres.astype(np.float32) * np.float32(0.001)
