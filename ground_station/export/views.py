"""Keyframes as posed images on disk, which nerfstudio's and COLMAP's formats then speak of."""

from __future__ import annotations

import io
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from ground_station.export.source import Source
from ground_station.reconstruction.reconstructor import ROTATION_TOLERANCE
from protocol.errors import CovreconError
from protocol.geometry import Floats, Intrinsics
from protocol.messages import Keyframe

IMAGES_FOLDER = "images"
DEPTHS_FOLDER = "depths"

_DRAFT = 8
"""JPEG decodes at an eighth of its size for a fraction of the time, and still needs all of its bytes."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One image and where it was taken from."""

    name: str
    """Of its file in the folder of images."""
    drone: int
    tick: int
    position: Floats
    """(3,) m, camera centre, world."""
    rotation: Floats
    """(3, 3) camera to world; camera axes right, down, forward (`protocol.geometry`)."""
    intrinsics: Intrinsics
    depth: str = ""
    """Name of its depth image's file in the folder of those (`protocol.depth_image`); empty without one."""


@dataclass(frozen=True, slots=True)
class Views:
    views: tuple[View, ...]
    """In the order in which the ground station took them in."""
    left_out: tuple[str, ...]
    """How many images are not among them, for each reason."""


def write_images(source: Source, folder: Path) -> Views:
    """Write every image that can be read into ``folder``/images, and what depth cameras measured into
    ``folder``/depths, byte for byte as the drone sent it.

    Keyframes that the map had no use for are among them: another method may have.

    Raises:
        CovreconError: there is none, or the source cannot be read.
        OSError: the disk refuses it.
    """
    images, depths = folder / IMAGES_FOLDER, folder / DEPTHS_FOLDER
    images.mkdir(exist_ok=True)
    views: list[View] = []
    refused: Counter[str] = Counter()
    seen: set[str] = set()
    for keyframe in source.keyframes():
        view = _view(keyframe)
        fault = "seen before" if view.name in seen else _fault(keyframe, view)
        if fault:
            refused[fault] += 1
            continue
        (images / view.name).write_bytes(keyframe.jpeg)
        if view.depth:
            depths.mkdir(exist_ok=True)
            (depths / view.depth).write_bytes(keyframe.depth)
        seen.add(view.name)
        views.append(view)
    if not views:
        raise CovreconError(f"{source.path}: has no keyframe that can be exported")
    return Views(tuple(views), tuple(_described(refused)))


def _view(keyframe: Keyframe) -> View:
    name = f"drone_{keyframe.drone}_{keyframe.sequence:06d}"
    return View(
        name=f"{name}.jpg",
        drone=keyframe.drone,
        tick=keyframe.tick,
        position=np.array(keyframe.position),
        rotation=np.array(keyframe.rotation),
        intrinsics=Intrinsics(keyframe.width, keyframe.height, keyframe.fx, keyframe.fy, keyframe.cx, keyframe.cy),
        depth=f"{name}.png" if keyframe.depth else "",
    )


def _fault(keyframe: Keyframe, view: View) -> str:
    """Why the keyframe is of no use to anybody, or ""."""
    skew = np.abs(view.rotation @ view.rotation.T - np.eye(3)).max()
    if skew > ROTATION_TOLERANCE or np.linalg.det(view.rotation) < 0:
        return "no rotation"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(keyframe.jpeg), formats=["JPEG"]) as image:
                if image.size != (keyframe.width, keyframe.height):
                    return "of another size than its camera"
                image.draft(None, (keyframe.width // _DRAFT, keyframe.height // _DRAFT))
                image.load()
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombWarning, Image.DecompressionBombError):
        return "damaged"
    return ""


def _described(refused: Counter[str]) -> Iterator[str]:
    for fault, count in sorted(refused.items()):
        yield f"left out: {count} of the keyframes: {fault}"
