"""Scenes that users bring: any mesh file that trimesh reads, checked before it gets near a camera.

Files are taken as z-up metres. glTF alone defines its axes (y up), so .glb and .gltf are turned: its (x, y, z)
becomes (x, -z, y). Textures, vertex colours and face colours are kept; what has none is grey.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.errors import SceneError
from protocol.geometry import Floats
from sim_bridge.scenes.surfaces import Surfaces, join

SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
SMALLEST_M = 0.05
LARGEST_M = 500.0
MOST_TRIANGLES = 5_000_000
_Y_UP = (".glb", ".gltf")
_PLAIN = (176, 172, 166)
"""Colour of a mesh that brings none: light grey, so that baked light shows its shape."""
_WHITE = (255, 255, 255)


def find_mesh(spec: str, relative_to: Path) -> Path:
    """The mesh file that ``spec`` means: itself, or the only one in the folder it names."""
    path = relative_to / Path(spec).expanduser()
    if path.is_dir():
        found = sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES)
        if len(found) != 1:
            names = ", ".join(file.name for file in found) or "none"
            raise SceneError(f"{path}: a scene folder holds exactly one of {', '.join(SUFFIXES)}; found {names}")
        return found[0]
    if not path.exists():
        raise SceneError(
            f"{path}: no such scene: neither a built-in name (living_room, room-<seed>) nor a file or folder; "
            "simulation.scene is relative to the mission file"
        )
    if path.suffix.lower() not in SUFFIXES:
        raise SceneError(f"{path}: not a mesh that can be read; known are {', '.join(SUFFIXES)}")
    return path


def read_mesh(path: Path) -> tuple[Surfaces, list[NDArray[np.uint8]]]:
    """Surfaces and images of a mesh file; raises `SceneError` where it cannot be shown."""
    import trimesh

    try:
        loaded = trimesh.load_scene(path)
        meshes = [mesh for mesh in loaded.dump() if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces)]
    except Exception as error:  # trimesh's parsers raise whatever their input makes them raise
        raise SceneError(f"{path}: cannot be read as a mesh: {type(error).__name__}: {error}") from error
    if not meshes:
        raise SceneError(f"{path}: no triangles in it")
    images: list[NDArray[np.uint8]] = []
    surfaces = join([_surfaces_of(mesh, images) for mesh in meshes])
    if path.suffix.lower() in _Y_UP:
        x, y, z = np.moveaxis(surfaces.triangles, -1, 0)
        surfaces = Surfaces(
            np.stack([x, -z, y], -1), surfaces.uv, surfaces.colour, surfaces.texture, surfaces.two_sided
        )
    return _checked(surfaces, path), images


def _checked(surfaces: Surfaces, path: Path) -> Surfaces:
    """Without triangles that have no area; raises `SceneError` for what no camera could photograph."""
    triangles = surfaces.triangles
    if not np.isfinite(triangles).all():
        raise SceneError(f"{path}: vertices that are not finite numbers")
    if len(triangles) > MOST_TRIANGLES:
        raise SceneError(f"{path}: {len(triangles):,} triangles; at most {MOST_TRIANGLES:,} can be shown")
    extent = float(np.ptp(triangles.reshape(-1, 3), axis=0).max())
    if not SMALLEST_M <= extent <= LARGEST_M:
        raise SceneError(
            f"{path}: {extent:g} m across; expected {SMALLEST_M:g} to {LARGEST_M:g} m. Is its unit the metre?"
        )
    areas = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    solid = areas > (1e-9 * extent) ** 2
    if not solid.any():
        raise SceneError(f"{path}: no triangle has an area")
    return Surfaces(
        *(array[solid] for array in (triangles, surfaces.uv, surfaces.colour, surfaces.texture, surfaces.two_sided))
    )


def _surfaces_of(mesh: Any, images: list[NDArray[np.uint8]]) -> Surfaces:
    """One mesh, its image appended to ``images``. Closed meshes are drawn from outside only."""
    triangles = np.asarray(mesh.triangles, dtype=np.float64)
    uv = np.zeros((len(triangles), 3, 2))
    colour = np.ones((len(triangles), 3, 3))
    visual = mesh.visual
    image, factor = _image_of(visual)
    if image is not None and getattr(visual, "uv", None) is not None and len(visual.uv) == len(mesh.vertices):
        uv = np.asarray(visual.uv, dtype=np.float64)[mesh.faces]
        uv[..., 1] = 1.0 - uv[..., 1]  # trimesh counts v from the bottom
        uv = np.where(np.isfinite(uv), uv, 0.0)
        colour *= factor
    elif visual.kind in ("vertex", "face"):
        image = _single(_WHITE)
        if visual.kind == "vertex":
            colour = visual.vertex_colors[mesh.faces][..., :3] / 255.0
        else:
            colour = np.repeat(visual.face_colors[:, None, :3] / 255.0, 3, axis=1)
    elif visual.kind == "texture":
        image = _single(_WHITE)
        colour *= factor
    else:
        image = _single(_PLAIN)
    texture = np.full(len(triangles), len(images), dtype=np.int32)
    images.append(image)
    closed = bool(mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0)
    return Surfaces(triangles, uv, colour, texture, np.full(len(triangles), not closed))


def _image_of(visual: Any) -> tuple[NDArray[np.uint8] | None, Floats]:
    """The base colour image, if there is one, and the factor on it, (3,)."""
    material = getattr(visual, "material", None)
    if material is None:
        return None, np.ones(3)
    image = getattr(material, "baseColorTexture", None)
    factor = getattr(material, "baseColorFactor", None)
    if hasattr(material, "image"):  # .obj
        image = material.image
        factor = None if image is not None else material.diffuse
    scale = np.ones(3) if factor is None else np.asarray(factor, dtype=np.float64)[:3] / 255.0
    if not hasattr(material, "image"):
        scale = scale ** (1 / 2.2)  # glTF factors are linear, its images are not
    return None if image is None else np.array(image.convert("RGB")), scale


def _single(colour: tuple[int, int, int]) -> NDArray[np.uint8]:
    return np.array([[colour]], dtype=np.uint8)
