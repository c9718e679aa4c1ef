"""The world that the simulated cameras see, built once and then read from the cache."""

from __future__ import annotations

import hashlib
import logging
import os
import re
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from protocol.errors import SceneError
from sim_bridge.scenes.surfaces import Surfaces
from sim_bridge.scenes.texture_set import TextureSet, build_texture_set, with_contrast

log = logging.getLogger(__name__)

BUILT_IN = ("living_room",)
RANDOM_ROOM = "room-"
"""A random furnished room is named by this and its seed."""
_BAKERY = ("scene", "surfaces", "lighting", "texture_set")
"""Modules that every scene's bytes depend on."""


@dataclass(frozen=True, slots=True)
class Scene:
    """Triangles in the order of a space-filling curve, so that neighbours in the arrays are neighbours in space.

    World frame, z up, metres. Equal scenes have equal fingerprints.
    """

    triangles: NDArray[np.float32]
    """[T, 3, 3] corners, counter-clockwise seen from the visible side."""
    uv: NDArray[np.float32]
    """[T, 3, 2]; 1 is one repeat of the texture, v runs down from its top row."""
    light: NDArray[np.float32]
    """[T, 3, 3] factor on the texture's red, green and blue at each corner: baked light times vertex colour."""
    texture: NDArray[np.int32]
    """[T] row of ``textures``."""
    two_sided: NDArray[np.bool_]
    """[T] whether the back is drawn too."""
    textures: TextureSet
    fingerprint: str
    """sha256 of the content, hexadecimal."""


Maker = Callable[[], tuple[Surfaces, list[NDArray[np.uint8]]]]
"""Makes surfaces without light, and the images that they use."""


def _quiet(_: str) -> None:
    pass


def load_scene(
    spec: str,
    *,
    relative_to: Path,
    cache: Path,
    texture_contrast: float = 1.0,
    on_progress: Callable[[str], None] = _quiet,
) -> Scene:
    """The scene called ``spec``: a built-in name, ``room-<seed>``, or the path of a mesh file or of a folder with one.

    Paths are taken relative to ``relative_to``. A scene is built on first use and kept under ``cache``;
    ``texture_contrast`` is the mission's `simulation.texture_contrast`; ``on_progress`` is told what takes time. Files
    are read as z-up metres (`sim_bridge.scenes.mesh_file`).

    Raises `SceneError`, naming the file, where nothing can be shown.
    """
    make, name, key = _source(spec, relative_to, on_progress)
    if texture_contrast != 1.0:
        key = hashlib.sha256(f"{key} {texture_contrast!r}".encode()).hexdigest()

    def generate() -> tuple[Surfaces, list[NDArray[np.uint8]]]:
        surfaces, images = make()
        return surfaces, [with_contrast(image, texture_contrast) for image in images]

    return _cached(cache / f"{name}-{key[:16]}.npz", generate, spec, on_progress)


def _source(spec: str, relative_to: Path, on_progress: Callable[[str], None]) -> tuple[Maker, str, str]:
    """What makes the scene, the name of its file in the cache, and a key of all that its bytes depend on."""
    if spec in BUILT_IN:
        from sim_bridge.scenes.living_room import living_room

        return living_room, spec, source_digest(*_BAKERY, "living_room", "arrangement", "furniture", "textures")
    seed = seed_of(spec)
    if seed is not None:
        from sim_bridge.scenes.random_room import random_room

        key = source_digest(*_BAKERY, "random_room", "arrangement", "living_room", "furniture", "textures")
        return partial(random_room, seed), spec, key
    from sim_bridge.scenes.mesh_file import find_mesh, read_mesh

    path = find_mesh(spec, relative_to)
    on_progress(f"reading {path.name}")
    surfaces, images = read_mesh(path)
    content = _digest([*(getattr(surfaces, field.name) for field in fields(surfaces)), *images])
    return lambda: (surfaces, images), "file", hashlib.sha256((source_digest(*_BAKERY) + content).encode()).hexdigest()


def seed_of(spec: str) -> int | None:
    """The seed of the random room that ``spec`` names, None for what names none.

    Raises `SceneError` for a bare name that only begins like a random room's.
    """
    if not spec.startswith(RANDOM_ROOM) or "/" in spec or Path(spec).suffix:
        return None
    seed = spec.removeprefix(RANDOM_ROOM)
    if not re.fullmatch("0|[1-9][0-9]{0,8}", seed):
        raise SceneError(
            f"{spec}: a random room is named {RANDOM_ROOM}<seed>, a seed of 0 to 999999999: {RANDOM_ROOM}7"
        )
    return int(seed)


def build_scene(surfaces: Surfaces, images: list[NDArray[np.uint8]]) -> Scene:
    """Bake light, sort, and pack."""
    from sim_bridge.scenes.lighting import bake

    return pack_scene(bake(surfaces), images)


def pack_scene(surfaces: Surfaces, images: list[NDArray[np.uint8]]) -> Scene:
    """A scene of surfaces whose ``colour`` already holds the light."""
    order = _curve_order(surfaces.triangles.mean(axis=1))
    arrays = (
        surfaces.triangles[order].astype(np.float32),
        surfaces.uv[order].astype(np.float32),
        surfaces.colour[order].astype(np.float32),
        surfaces.texture[order],
        surfaces.two_sided[order],
    )
    textures = build_texture_set(images)
    fingerprint = _digest([*arrays, textures.texels, textures.offsets, textures.sizes])
    return Scene(*arrays, textures, fingerprint)


def _curve_order(centres: NDArray[np.float64]) -> NDArray[np.int64]:
    """Order along a Morton curve of 2^10 steps a side."""
    low, high = centres.min(axis=0), centres.max(axis=0)
    steps = ((centres - low) / np.maximum(high - low, 1e-9).max() * 1023).astype(np.int64)
    code = np.zeros(len(centres), dtype=np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= (steps[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")


def _cached(
    path: Path,
    generate: Maker,
    name: str,
    on_progress: Callable[[str], None],
) -> Scene:
    if path.exists():
        try:
            return _read(path)
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            log.warning("%s is damaged (%s): building the scene again", path, error)
    on_progress(f"building scene {name}")
    scene = build_scene(*generate())
    _write(path, scene)
    return scene


def _read(path: Path) -> Scene:
    with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
        return Scene(
            triangles=data["triangles"],
            uv=data["uv"],
            light=data["light"],
            texture=data["texture"],
            two_sided=data["two_sided"],
            textures=TextureSet(data["texels"], data["offsets"], data["sizes"]),
            fingerprint=str(data["fingerprint"]),
        )


def _write(path: Path, scene: Scene) -> None:
    with replace_file(path) as file:
        np.savez(
            file,
            triangles=scene.triangles,
            uv=scene.uv,
            light=scene.light,
            texture=scene.texture,
            two_sided=scene.two_sided,
            texels=scene.textures.texels,
            offsets=scene.textures.offsets,
            sizes=scene.textures.sizes,
            fingerprint=np.array(scene.fingerprint),
        )


def _digest(arrays: list[NDArray[np.generic]]) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def source_digest(*modules: str) -> str:
    """Changes with the code of ``modules`` of this package, so that no cache outlives what filled it."""
    digest = hashlib.sha256()
    for module in modules:
        digest.update(Path(__file__).with_name(f"{module}.py").read_bytes())
    return digest.hexdigest()


@contextmanager
def replace_file(path: Path) -> Iterator[BinaryIO]:
    """Write a file that appears whole or not at all, whoever else writes it at the same time."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with partial.open("wb") as file:
            yield file
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
