"""Pictures of the map without a graphics driver: rays through Open3D's CPU ray caster, shaded here.

Open3D's own offscreen renderer needs Vulkan, and draws the same view with other bytes each time.
"""

from __future__ import annotations

import io
import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ground_station.report.run_data import Mesh
from protocol.geometry import Floats, optical_axis

Picture: TypeAlias = NDArray[np.uint8]
Vertices: TypeAlias = NDArray[np.float32]
Rays: TypeAlias = NDArray[np.float32]

SUPERSAMPLING = 2
"""Rays per pixel along each side."""
VIEW_YAW_RAD = math.radians(60)
VIEW_PITCH_RAD = math.radians(38)
"""Direction the oblique view looks in; the depression shows tops and fronts alike."""
VERTICAL_FOV_RAD = math.radians(30)
"""Narrow, so that near furniture does not dwarf what stands behind."""
MARGIN = 1.04
AMBIENT, SKY, KEY = 0.42, 0.28, 0.42
"""Shares of light from everywhere, from above, and from one side; they add up to a bit over 1 to brighten."""
KEY_LIGHT = np.array([-0.45, -0.35, 0.82], np.float32)
"""Direction towards the lamp, world frame."""
EDGE_GAIN = 9.0
"""Darkening at a jump in depth, per relative depth (eye-dome lighting, Boucheny 2009)."""
EDGE_FLOOR = 0.45
"""Darkest an edge may get."""
BACKGROUND = 255


def oblique_view(mesh: Mesh, width: int, height: int, framed: Vertices | None = None) -> Picture:
    """The whole mesh from a corner, in perspective; uint8 (height, width, 3), white behind.

    ``framed``: points (n, 3) that just fit into the picture; the mesh's own by default.
    """
    if framed is None:
        framed = mesh.vertices
    forward = optical_axis(VIEW_YAW_RAD, VIEW_PITCH_RAD)
    right = np.array([math.sin(VIEW_YAW_RAD), -math.cos(VIEW_YAW_RAD), 0.0])
    down = np.cross(forward, right)
    tangent = np.array([width / height, 1.0]) * math.tan(VERTICAL_FOV_RAD / 2)
    centre = (framed.min(axis=0) + framed.max(axis=0)) / 2
    around = framed - centre
    sideways = np.column_stack([around @ right, around @ down])
    ahead = (around @ forward)[:, None]
    # Each side of the frame is a plane through the camera; the farthest vertex beyond it tells where it must stand.
    far, near = (sideways - tangent * ahead).max(axis=0), (-sideways - tangent * ahead).max(axis=0)
    back = MARGIN * float(((far + near) / (2 * tangent)).max())
    offset = (far - near) / 2
    camera = centre + offset[0] * right + offset[1] * down - back * forward

    columns, rows = _pixel_grid(width, height)
    across, along = (tangent[:, None] * [right, down]).astype(np.float32)
    rays = np.empty((*columns.shape, 6), np.float32)
    rays[..., :3] = camera
    rays[..., 3:] = columns[..., None] * across + rows[..., None] * along + forward.astype(np.float32)
    return _shaded(mesh, rays)


def view_from_above(mesh: Mesh, lower: tuple[float, ...], upper: tuple[float, ...], longest: int) -> Picture:
    """A plan: parallel rays straight down over the rectangle from ``lower`` to ``upper`` (x, y), x to the right.

    ``longest`` is the picture's longer side in pixels.
    """
    (x0, y0), (x1, y1) = lower[:2], upper[:2]
    per_metre = longest / max(x1 - x0, y1 - y0)
    columns, rows = _pixel_grid(max(1, round(per_metre * (x1 - x0))), max(1, round(per_metre * (y1 - y0))))
    rays = np.empty((*columns.shape, 6), np.float32)
    rays[..., 0] = (x0 + x1) / 2 + columns * ((x1 - x0) / 2)
    rays[..., 1] = (y0 + y1) / 2 - rows * ((y1 - y0) / 2)
    rays[..., 2] = mesh.vertices[:, 2].max() + 1
    rays[..., 3:] = 0, 0, -1
    return _shaded(mesh, rays)


def png(picture: Picture) -> bytes:
    content = io.BytesIO()
    Image.fromarray(picture).save(content, format="png", optimize=True)
    return content.getvalue()


def _pixel_grid(width: int, height: int) -> tuple[Rays, Rays]:
    """Supersampled image coordinates in [-1, 1], right and down, each (rows, columns)."""
    columns, rows = ((2 * np.arange(rays) + 1) / rays - 1 for rays in (width * SUPERSAMPLING, height * SUPERSAMPLING))
    grid_columns, grid_rows = np.meshgrid(columns.astype(np.float32), rows.astype(np.float32))
    return grid_columns, grid_rows


def _shaded(mesh: Mesh, rays: Rays) -> Picture:
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor.from_numpy(np.ascontiguousarray(mesh.vertices)),
        o3d.core.Tensor.from_numpy(mesh.faces.astype(np.uint32)),
    )
    hits = scene.cast_rays(o3d.core.Tensor.from_numpy(rays))
    depth = hits["t_hit"].numpy()
    seen = np.isfinite(depth)
    faces = mesh.faces[hits["primitive_ids"].numpy()[seen].astype(np.int64)]
    u, v = hits["primitive_uvs"].numpy()[seen].T[:, :, None]
    at_vertices = np.column_stack([_vertex_normals(mesh), mesh.colours]).astype(np.float32)
    hit = (1 - u - v) * at_vertices[faces[:, 0]] + u * at_vertices[faces[:, 1]] + v * at_vertices[faces[:, 2]]
    normals, colours = hit[:, :3], hit[:, 3:]

    # A surface is lit on the side that is looked at: a scan has no inside.
    away = np.einsum("nx,nx->n", normals, rays[seen][:, 3:]) > 0
    length = np.linalg.norm(normals, axis=1)
    normals /= np.where(away, -1, 1)[:, None] * np.maximum(length, np.finfo(np.float32).tiny)[:, None]
    key = np.clip(normals @ (KEY_LIGHT / np.linalg.norm(KEY_LIGHT)), 0, None)
    light = (AMBIENT + SKY * (0.5 + 0.5 * normals[:, 2]) + KEY * key) * _edge_shade(depth)[seen]

    image = np.full((*depth.shape, 3), BACKGROUND, np.float32)
    image[seen] = np.clip(colours * light[:, None], 0, 255)
    height, width = (side // SUPERSAMPLING for side in depth.shape)
    blocks = image.reshape(height, SUPERSAMPLING, width, SUPERSAMPLING, 3)
    return np.asarray(np.round(blocks.mean(axis=(1, 3))), dtype=np.uint8)


def _vertex_normals(mesh: Mesh) -> Floats:
    """(V, 3), weighted by area, not of unit length."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]].astype(np.float64) for corner in range(3))
    of_faces = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    at = mesh.faces.ravel()
    sums = [np.bincount(at, weights=of_faces[:, axis], minlength=len(mesh.vertices)) for axis in range(3)]
    return np.stack(sums, axis=1)


def _edge_shade(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """1 on smooth surface, less where a neighbouring ray ends nearer: outlines that light alone does not show."""
    reach = SUPERSAMPLING
    padded = np.pad(np.where(np.isfinite(depth), depth, np.inf), reach, mode="edge")
    inner = slice(reach, -reach)
    here = padded[inner, inner]
    shade = np.zeros_like(depth)
    for rows, columns in (
        (slice(None, -2 * reach), inner),
        (slice(2 * reach, None), inner),
        (inner, slice(None, -2 * reach)),
        (inner, slice(2 * reach, None)),
    ):
        with np.errstate(invalid="ignore"):  # background beside background
            nearer = (here - padded[rows, columns]) / here
        shade += np.nan_to_num(np.clip(nearer, 0, None), nan=0.0)
    return np.asarray(np.maximum(np.exp(-EDGE_GAIN * shade), EDGE_FLOOR))
