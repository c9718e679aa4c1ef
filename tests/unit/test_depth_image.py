"""Depth crosses to the millimetre, and what is no depth image is refused."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from protocol.depth_image import FARTHEST_M, decode_depth, encode_depth
from protocol.errors import MessageError


def png(image: Image.Image) -> bytes:
    content = io.BytesIO()
    image.save(content, "PNG")
    return content.getvalue()


def test_depth_comes_out_as_it_went_in_to_half_a_millimetre() -> None:
    depth = np.random.default_rng(1).uniform(0.05, 9.0, (72, 128)).astype(np.float32)
    found = decode_depth(encode_depth(depth), 320, 180)
    assert found.dtype == np.float32
    assert np.abs(found - depth).max() < 0.000501


@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan, -1.0, 0.0, FARTHEST_M + 1])
def test_what_no_depth_camera_can_say_is_unknown(value: float) -> None:
    depth = np.full((9, 16), 1.5, np.float32)
    depth[3, 4] = value
    found = decode_depth(encode_depth(depth), 160, 90)
    assert found[3, 4] == 0
    assert np.count_nonzero(found) == depth.size - 1


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"", "cannot be read"),
        (b"\x89PNG\r\n\x1a\n", "cannot be read"),
        (encode_depth(np.ones((72, 128), np.float32))[:-200], "cannot be read"),
        (encode_depth(np.ones((128, 72), np.float32)), "72 x 128 pixels does not fit 320 x 180"),
        (encode_depth(np.ones((1, 4096), np.float32)), "does not fit"),
        (png(Image.new("L", (128, 72))), "pixels of kind L"),
        (png(Image.new("RGB", (128, 72))), "pixels of kind RGB"),
    ],
)
def test_another_image_is_refused(content: bytes, complaint: str) -> None:
    with pytest.raises(MessageError, match=complaint):
        decode_depth(content, 320, 180)
