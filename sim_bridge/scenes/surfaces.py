"""Triangles on their way into a scene, and the solids that furniture is made of.

Everything is a `Surfaces`: a furniture part, a whole room, a file that a user brought. World frame, z up, metres;
corners run counter-clockwise seen from the visible side.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from protocol.geometry import Floats


@dataclass(frozen=True, slots=True)
class Surfaces:
    triangles: Floats
    """[T, 3, 3] corners, metres."""
    uv: Floats
    """[T, 3, 2] texture coordinates; 1 is one repeat, v runs down from the image's top row."""
    colour: Floats
    """[T, 3, 3] factor on the texture, 1 leaves it alone."""
    texture: NDArray[np.int32]
    """[T] index of the image."""
    two_sided: NDArray[np.bool_]
    """[T] drawn from behind too."""

    def moved(self, x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw_deg: float = 0.0) -> Surfaces:
        """Turned about the z axis, then shifted."""
        c, s = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return replace(self, triangles=self.triangles @ turn.T + (x, y, z))

    def tilted(self, about_x_deg: float) -> Surfaces:
        """Turned about the x axis; a positive angle lifts what lies towards +y."""
        c, s = math.cos(math.radians(about_x_deg)), math.sin(math.radians(about_x_deg))
        turn = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
        return replace(self, triangles=self.triangles @ turn.T)


@dataclass(frozen=True, slots=True)
class Material:
    texture: int
    tile_m: float = 1.0
    """Length of one repeat of the texture."""
    two_sided: bool = False


def join(parts: Sequence[Surfaces]) -> Surfaces:
    return Surfaces(
        np.concatenate([part.triangles for part in parts]),
        np.concatenate([part.uv for part in parts]),
        np.concatenate([part.colour for part in parts]),
        np.concatenate([part.texture for part in parts]),
        np.concatenate([part.two_sided for part in parts]),
    )


def surface(triangles: Floats, uv: Floats, material: Material) -> Surfaces:
    count = len(triangles)
    return Surfaces(
        np.asarray(triangles, dtype=np.float64),
        np.asarray(uv, dtype=np.float64),
        np.ones((count, 3, 3)),
        np.full(count, material.texture, dtype=np.int32),
        np.full(count, material.two_sided),
    )


def quad(corners: Sequence[Sequence[float]], material: Material, uv: Sequence[float] | None = None) -> Surfaces:
    """Four corners: lower left, lower right, upper right, upper left as the viewer sees them.

    ``uv`` is the part of the image shown: left, top, right, bottom; by default as much as fits ``tile_m``.
    """
    points = np.array(corners, dtype=np.float64)
    if uv is None:
        uv = (
            0.0,
            0.0,
            math.dist(points[0], points[1]) / material.tile_m,
            math.dist(points[0], points[3]) / material.tile_m,
        )
    left, top, right, bottom = uv
    coordinates = np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
    order = np.array([[0, 1, 2], [0, 2, 3]])
    return surface(points[order], coordinates[order], material)


def box(
    size: tuple[float, float, float],
    material: Material,
    at: tuple[float, float, float] = (0.0, 0.0, 0.0),
    without: str = "",
) -> Surfaces:
    """Box of full ``size`` whose bottom is centred on ``at``; ``without`` names faces to leave out, of "xXyYzZ".

    Texture runs along the longest side of each face, as grain does.
    """
    half_x, half_y = size[0] / 2, size[1] / 2
    x0, x1, y0, y1, z0, z1 = at[0] - half_x, at[0] + half_x, at[1] - half_y, at[1] + half_y, at[2], at[2] + size[2]
    faces = {
        "x": [(x0, y1, z0), (x0, y0, z0), (x0, y0, z1), (x0, y1, z1)],
        "X": [(x1, y0, z0), (x1, y1, z0), (x1, y1, z1), (x1, y0, z1)],
        "y": [(x0, y0, z0), (x1, y0, z0), (x1, y0, z1), (x0, y0, z1)],
        "Y": [(x1, y1, z0), (x0, y1, z0), (x0, y1, z1), (x1, y1, z1)],
        "z": [(x0, y1, z0), (x1, y1, z0), (x1, y0, z0), (x0, y0, z0)],
        "Z": [(x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1)],
    }
    sides = []
    for number, (name, corners) in enumerate(faces.items()):
        if name in without:
            continue
        if math.dist(corners[0], corners[1]) < math.dist(corners[0], corners[3]):
            side = quad(corners[1:] + corners[:1], material)
        else:
            side = quad(corners, material)
        # Each face shows another part of the image, so that no edge is a mirror.
        sides.append(replace(side, uv=side.uv + number * 0.37))
    return join(sides)


def cushion(
    size: tuple[float, float, float],
    radius: float,
    material: Material,
    at: tuple[float, float, float] = (0.0, 0.0, 0.0),
    bulge: float = 0.0,
) -> Surfaces:
    """Box with rounded edges, bottom centred on ``at``; ``bulge`` is how much the top and bottom swell, metres."""
    half = np.array(size) / 2
    radius = min(radius, float(half.min()))
    arc = radius * np.tan(np.linspace(0.0, math.pi / 4, 3))
    axes = []
    for extent in half:
        inner = np.linspace(-(extent - radius), extent - radius, 5 if bulge else 2)
        axes.append(np.unique(np.round(np.concatenate([-(extent - radius) - arc, inner, (extent - radius) + arc]), 9)))
    parts = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            across, up = ((axis + 1) % 3, (axis + 2) % 3) if sign > 0 else ((axis + 2) % 3, (axis + 1) % 3)
            columns, rows = np.meshgrid(axes[across], axes[up])
            points = np.empty((*columns.shape, 3))
            points[..., axis], points[..., across], points[..., up] = sign * half[axis], columns, rows
            inner_box = np.clip(points, -(half - radius), half - radius)
            outwards = points - inner_box
            length = np.linalg.norm(outwards, axis=-1, keepdims=True)
            points = inner_box + radius * outwards / np.maximum(length, 1e-12)
            if bulge:
                swell = np.cos(points[..., 0] / half[0] * math.pi / 2) * np.cos(points[..., 1] / half[1] * math.pi / 2)
                points[..., 2] += np.sign(points[..., 2]) * bulge * np.clip(swell, 0.0, None)
            parts.append(_grid(points, np.stack([columns, rows], axis=-1) / material.tile_m + axis * 0.37, material))
    return join(parts).moved(at[0], at[1], at[2] + half[2])


def lathe(profile: Sequence[tuple[float, float]], material: Material, sides: int = 16) -> Surfaces:
    """Turned solid: ``profile`` lists (radius, height) from bottom to top, seen from outside."""
    outline = np.array(profile)
    angle = np.linspace(0.0, 2 * math.pi, sides + 1)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    ring[-1] = ring[0]
    points = np.concatenate(
        [outline[:, None, :1] * ring[None], np.broadcast_to(outline[:, None, 1:], (len(outline), sides + 1, 1))],
        axis=-1,
    )
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(outline, axis=0), axis=1))])
    # A whole number of repeats around, so that the seam does not show.
    repeats = max(1, round(2 * math.pi * float(outline[:, 0].max()) / material.tile_m))
    columns, rows = np.meshgrid(angle / (2 * math.pi) * repeats, -along / material.tile_m)
    return _grid(points, np.stack([columns, rows], axis=-1), material)


def rod(start: Sequence[float], end: Sequence[float], radius: float, material: Material, sides: int = 8) -> Surfaces:
    """Cylinder with closed ends between two points."""
    axis = np.subtract(end, start)
    length = float(np.linalg.norm(axis))
    upright = lathe([(0.0, 0.0), (radius, 0.0), (radius, length), (0.0, length)], material, sides)
    forward = axis / length
    across = np.cross([0.0, 1.0, 0.0] if abs(forward[1]) < 0.9 else [1.0, 0.0, 0.0], forward)
    across /= np.linalg.norm(across)
    turn = np.column_stack([across, np.cross(forward, across), forward])
    return replace(upright, triangles=upright.triangles @ turn.T + np.asarray(start))


def _grid(points: Floats, uv: Floats, material: Material) -> Surfaces:
    """Quads of a grid of points [rows, columns, 3]; columns x rows points to the visible side."""
    a, b, c, d = points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]
    ua, ub, uc, ud = uv[:-1, :-1], uv[:-1, 1:], uv[1:, 1:], uv[1:, :-1]
    triangles = np.concatenate([np.stack([a, b, c], -2).reshape(-1, 3, 3), np.stack([a, c, d], -2).reshape(-1, 3, 3)])
    coordinates = np.concatenate(
        [np.stack([ua, ub, uc], -2).reshape(-1, 3, 2), np.stack([ua, uc, ud], -2).reshape(-1, 3, 2)]
    )
    area = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    whole = area > 1e-12  # the axis of a lathe
    return surface(triangles[whole], coordinates[whole], material)
