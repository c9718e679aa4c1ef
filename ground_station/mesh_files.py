"""The map as files and back: PLY in the world frame, GLB with y up as glTF demands, and a hash to compare maps by."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ground_station.reconstruction.reconstructor import Mesh
from protocol.errors import CovreconError

GLB_MATERIAL = {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}, "doubleSided": True}
"""Without it viewers show glTF's default, a dark metal."""

Vertices: TypeAlias = NDArray[np.float32]
Faces: TypeAlias = NDArray[np.int32]
Colours: TypeAlias = NDArray[np.uint8]


def mesh_sha256(vertices: Vertices, faces: Faces) -> str:
    """Hash over the vertices as little-endian float32, then the faces as little-endian int32."""
    digest = hashlib.sha256(np.ascontiguousarray(vertices, dtype="<f4").tobytes())
    digest.update(np.ascontiguousarray(faces, dtype="<i4").tobytes())
    return digest.hexdigest()


def ply(vertices: Vertices, faces: Faces, colours: Colours) -> bytes:
    return _exported(vertices, faces, colours, "ply")


def _exported(vertices: Vertices, faces: Faces, colours: Colours, file_type: str, **options: Any) -> bytes:
    import trimesh

    content = io.BytesIO()
    mesh = trimesh.Trimesh(vertices, faces, vertex_colors=colours, process=False)
    mesh.export(content, file_type=file_type, **options)
    return content.getvalue()


def glb(vertices: Vertices, faces: Faces, colours: Colours) -> bytes:
    """glTF 2.0: y up, right-handed, and vertex colours linear in light rather than sRGB (sections 3.4, 3.7.2.1)."""

    def add_material(tree: dict[str, Any]) -> None:
        tree["materials"] = [GLB_MATERIAL]
        tree["meshes"][0]["primitives"][0]["material"] = 0

    upright = np.column_stack([vertices[:, 0], vertices[:, 2], -vertices[:, 1]])
    level = np.arange(256) / 255
    linear = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
    shown = np.round(255 * linear).astype(np.uint8)[colours]
    return _exported(upright, faces, shown, "glb", tree_postprocessor=add_material)


def read_ply(content: bytes, name: str) -> Mesh:
    """What `ply` made.

    Raises:
        CovreconError: ``name`` is damaged, or has no triangles or colours.
    """
    return _read(content, name, "ply")


def read_glb(content: bytes, name: str) -> Mesh:
    """What `glb` made, in the world frame again; dark colours come back a little coarser than they were.

    Raises:
        CovreconError: ``name`` is damaged, or has no triangles or colours.
    """
    found = _read(content, name, "glb")
    x, up, back = found.vertices.T
    level = np.arange(256) / 255
    encoded = np.where(level <= 0.0031308, level * 12.92, 1.055 * level ** (1 / 2.4) - 0.055)  # IEC 61966-2-1
    shown = np.round(255 * encoded).astype(np.uint8)[found.colors]
    return Mesh(np.column_stack([x, -back, up]), found.faces, shown)


def read_geometry(path: Path) -> tuple[Vertices, Faces]:
    """Vertices (V, 3) and faces (F, 3) of any program's mesh file, in z-up metres; glTF, which is y-up, is turned.

    Raises:
        CovreconError: it is no mesh with triangles, or cannot be read.
    """
    import trimesh

    if not path.is_file():
        raise CovreconError(f"{path}: no such mesh file")
    try:
        mesh = trimesh.load_scene(path, process=False).to_mesh()
        vertices, faces = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32).reshape(-1, 3)
    except Exception as error:  # trimesh's parsers raise whatever their input makes them raise
        raise CovreconError(f"{path}: cannot be read as a mesh: {type(error).__name__}: {error}") from error
    if not len(faces) or not np.isfinite(vertices).all():
        raise CovreconError(f"{path}: no mesh of finite triangles")
    if path.suffix.lower() in (".glb", ".gltf"):
        vertices = np.column_stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]])
    return np.ascontiguousarray(vertices), np.ascontiguousarray(faces)


def _read(content: bytes, name: str, file_type: str) -> Mesh:
    import trimesh

    try:
        # Not load_mesh, which loses the colours of a mesh with a material.
        (mesh,) = trimesh.load_scene(io.BytesIO(content), file_type=file_type, process=False).geometry.values()
        visual = mesh.visual
        colours = visual.vertex_colors if visual.kind == "vertex" else visual.vertex_attributes["color"]
        vertices, faces = mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32)
    except (ValueError, KeyError, IndexError, TypeError, AttributeError) as error:
        raise CovreconError(f"{name}: no mesh with triangles and colours: {error}") from error
    return Mesh(vertices, faces, np.asarray(colours, dtype=np.uint8)[:, :3])
