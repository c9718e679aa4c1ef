"""Furniture of ordinary sizes, each standing on z = 0 around the origin and facing +y."""

from __future__ import annotations

import itertools
import math

import numpy as np

from sim_bridge.scenes.surfaces import Material, Surfaces, box, cushion, join, lathe, quad, rod, surface
from sim_bridge.scenes.textures import TEXTURE


def material(texture: str, tile_m: float = 0.6, two_sided: bool = False) -> Material:
    return Material(TEXTURE[texture], tile_m, two_sided)


def sofa(seats: int, cloth: Material, throw: Material | None = None) -> Surfaces:
    """Upholstered, 0.66 m a seat, arms of 0.2 m; an armchair is a sofa for one."""
    width = seats * 0.66
    feet = material("walnut")
    parts = [cushion((width + 0.4, 0.86, 0.2), 0.04, cloth, (0, 0, 0.1))]
    for seat in range(seats):
        x = (seat + 0.5) * 0.66 - width / 2
        parts.append(cushion((0.65, 0.66, 0.16), 0.05, cloth, (x, 0.09, 0.29), bulge=0.02))
        back = cushion((0.64, 0.18, 0.48), 0.07, cloth, (0, 0, 0)).tilted(8)
        parts.append(back.moved(x, -0.22, 0.42))
    parts.append(cushion((width + 0.36, 0.16, 0.72), 0.06, cloth, (0, -0.35, 0.1)))
    for side in (-1, 1):
        parts.append(cushion((0.2, 0.84, 0.5), 0.07, cloth, (side * (width / 2 + 0.1), 0.01, 0.12)))
        foot = lathe([(0.018, 0.0), (0.03, 0.11)], feet, 8)
        parts += [foot.moved(side * (width / 2 + 0.08), end) for end in (-0.36, 0.36)]
    if throw is not None:
        parts.append(cushion((0.5, 0.8, 0.02), 0.01, throw, (width / 2 - 0.3, 0.06, 0.475)))
        parts.append(cushion((0.26, 0.6, 0.02), 0.01, throw, (width / 2 + 0.1, 0.0, 0.617)))
    return join(parts)


def pillow(cover: Material) -> Surfaces:
    """0.42 m square, standing on its edge and leaning back."""
    return cushion((0.42, 0.42, 0.1), 0.05, cover, (0, 0, -0.05), bulge=0.05).tilted(-66).moved(0, 0, 0.2)


def table(length: float, width: float, height: float, wood: Material) -> Surfaces:
    leg = max(0.045, height * 0.08)
    parts = [box((length, width, 0.035), wood, (0, 0, height - 0.035))]
    for x in (-1, 1):
        for y in (-1, 1):
            at = (x * (length / 2 - leg), y * (width / 2 - leg), 0.0)
            parts.append(box((leg, leg, height - 0.035), wood, at, without="zZ"))
    rail = (length - 3 * leg, 0.02, 0.07)
    parts += [box(rail, wood, (0, y * (width / 2 - leg), height - 0.105)) for y in (-1, 1)]
    rail = (0.02, width - 3 * leg, 0.07)
    parts += [box(rail, wood, (x * (length / 2 - leg), 0, height - 0.105)) for x in (-1, 1)]
    return join(parts)


def chair(wood: Material, cloth: Material) -> Surfaces:
    parts = [cushion((0.44, 0.42, 0.06), 0.025, cloth, (0, 0.01, 0.43))]
    parts.append(box((0.42, 0.4, 0.03), wood, (0, 0, 0.405)))
    for x in (-0.185, 0.185):
        parts.append(box((0.035, 0.035, 0.405), wood, (x, 0.18, 0), without="zZ"))
        parts.append(box((0.035, 0.035, 0.92), wood, (x, -0.19, 0), without="z"))
        parts.append(box((0.02, 0.34, 0.025), wood, (x, 0, 0.18)))
    parts += [box((0.335, 0.02, 0.075), wood, (0, -0.19, z)) for z in (0.58, 0.7, 0.82)]
    return join(parts)


def wardrobe(width: float, depth: float, height: float, wood: Material, doors: Material) -> Surfaces:
    parts = [box((width, depth - 0.03, height), wood, (0, -0.015, 0), without="z")]
    leaf = width / 2 - 0.015
    for side in (-1, 1):
        x = side * width / 4
        parts.append(box((leaf, 0.022, height - 0.14), doors, (x, depth / 2 - 0.019, 0.1)))
        for bottom, top in ((0.18, height * 0.45), (height * 0.52, height - 0.14)):
            parts.append(box((leaf - 0.16, 0.012, top - bottom), wood, (x, depth / 2 - 0.002, bottom)))
        grip = [(side * 0.04, depth / 2 + 0.035, height / 2 - end) for end in (0.09, -0.09)]
        parts.append(rod(grip[0], grip[1], 0.012, material("metal")))
    parts.append(box((width + 0.06, depth + 0.04, 0.04), wood, (0, 0, height)))
    return join(parts)


def bookshelf(width: float, depth: float, height: float, wood: Material, rng: np.random.Generator) -> Surfaces:
    """Boards with rows of books of uneven height and depth."""
    board = 0.025
    levels = np.linspace(0.06, height - board, 6)
    parts = [box((board, depth, height), wood, (x * (width - board) / 2, 0, 0), without="z") for x in (-1, 1)]
    parts.append(box((width - 2 * board, 0.012, height - 0.06), wood, (0, -depth / 2 + 0.006, 0.06)))
    parts += [box((width - 2 * board, depth - 0.012, board), wood, (0, 0.006, float(z))) for z in levels]
    spines = material("books")
    for level, (low, high) in enumerate(itertools.pairwise(levels)):
        left, limit = -width / 2 + board + 0.004, width / 2 - board - 0.12
        while left < limit:
            block = min(float(rng.uniform(0.08, 0.3)), limit - left + 0.08)
            if rng.random() < 0.12:
                left += block
                continue
            tall = (high - low - board) * rng.uniform(0.62, 0.93)
            deep = depth * rng.uniform(0.55, 0.78)
            shown = (float(rng.uniform(0, 0.6)), (level % 4) / 4)
            parts.append(
                _row_of_books((block, deep, tall), spines, shown).moved(
                    left + block / 2, depth * 0.4 - deep / 2, low + board
                )
            )
            left += block + 0.002
    return join(parts)


def _row_of_books(size: tuple[float, float, float], spines: Material, shown: tuple[float, float]) -> Surfaces:
    """Box whose front, sides and top show the strip of spines that starts at ``shown`` (u, v)."""
    width, deep, tall = size
    x, y, u, v = width / 2, deep / 2, shown[0], shown[1]
    page = material("linen", 0.15)
    strip = (u, v, u + width, v + 0.25)  # one image is as wide as a metre of books
    end = (u, v + 0.02, u + 0.012, v + 0.23)
    return join(
        [
            quad([(x, y, 0), (-x, y, 0), (-x, y, tall), (x, y, tall)], spines, strip),
            quad([(-x, -y, tall), (x, -y, tall), (x, y, tall), (-x, y, tall)], page),
            quad([(x, -y, 0), (x, y, 0), (x, y, tall), (x, -y, tall)], spines, end),
            quad([(-x, y, 0), (-x, -y, 0), (-x, -y, tall), (-x, y, tall)], spines, end),
        ]
    )


def stack_of_books(count: int, rng: np.random.Generator) -> Surfaces:
    parts, height = [], 0.0
    for _ in range(count):
        size = (float(rng.uniform(0.14, 0.2)), float(rng.uniform(0.2, 0.27)), float(rng.uniform(0.02, 0.04)))
        cover = Material(TEXTURE["pictures"], float(rng.uniform(0.4, 0.7)))
        parts.append(box(size, cover, without="z").moved(0, 0, height, float(rng.uniform(-20, 20))))
        height += size[2]
    return join(parts)


def sideboard(width: float, depth: float, height: float, wood: Material, fronts: Material) -> Surfaces:
    parts = [box((width, depth, height - 0.12), wood, (0, 0, 0.12))]
    for door in range(3):
        x = (door - 1) * width / 3
        parts.append(box((width / 3 - 0.02, 0.018, height - 0.16), fronts, (x, depth / 2 + 0.006, 0.14)))
        parts.append(
            rod(
                (x + 0.12, depth / 2 + 0.03, height / 2),
                (x + 0.12, depth / 2 + 0.03, height / 2 + 0.1),
                0.008,
                material("metal"),
            )
        )
    for x in (-1, 1):
        for y in (-1, 1):
            at = (x * (width / 2 - 0.06), y * (depth / 2 - 0.05))
            parts.append(lathe([(0.015, 0.0), (0.026, 0.13)], wood, 8).moved(*at))
    return join(parts)


def floor_lamp() -> Surfaces:
    metal, shade = material("metal", 0.2), material("linen", 0.3, two_sided=True)
    return join(
        [
            lathe([(0.16, 0.0), (0.16, 0.02), (0.03, 0.035), (0.013, 0.06), (0.013, 1.35)], metal, 20),
            lathe([(0.23, 1.26), (0.15, 1.6)], shade, 24),
        ]
    )


def plant(rng: np.random.Generator, height: float = 1.3) -> Surfaces:
    """Potted plant with broad arching leaves."""
    pot = [(0.13, 0.0), (0.19, 0.32), (0.205, 0.32), (0.205, 0.36), (0.175, 0.36), (0.165, 0.3)]
    parts = [lathe(pot, material("clay", 0.3), 20), lathe([(0.168, 0.31), (0.0, 0.33)], material("soil", 0.2), 20)]
    green = material("leaf", two_sided=True)
    stem = material("leaf", 0.2)
    for number in range(22):
        yaw = number * 137.5
        share = number / 21
        base = 0.35 + 0.3 * share
        reach, rise = 0.42 - 0.2 * share, (height - base) * (0.45 + 0.5 * share)
        tip = (0.1 + 0.05 * share, 0.0, base + rise * 0.6)
        parts.append(rod((0.02, 0, 0.3), tip, 0.006, stem, 5).moved(yaw_deg=yaw))
        parts.append(
            _leaf(reach, float(rng.uniform(0.13, 0.18)), rise * 0.4, green).moved(tip[0], 0, tip[2]).moved(yaw_deg=yaw)
        )
    return join(parts)


def _leaf(length: float, width: float, rise: float, green: Material, steps: int = 6) -> Surfaces:
    """Arching blade from the origin towards +x, creased along its middle."""
    t = np.linspace(0.0, 1.0, steps + 1)
    half = width / 2 * np.sin(np.pi * np.clip(t * 0.92 + 0.04, 0, 1)) ** 0.8
    spine = np.column_stack([length * t, np.zeros_like(t), rise * np.sin(t * 2.2)])
    triangles, uv = [], []
    for side in (-1.0, 1.0):
        rim = spine + np.column_stack([np.zeros_like(t), side * half, 0.25 * half])
        for i in range(steps):
            a, b, c, d = spine[i], spine[i + 1], rim[i + 1], rim[i]
            ta, tb, u = 1 - t[i], 1 - t[i + 1], 0.5 + side * 0.48
            triangles += [[a, b, c], [a, c, d]]
            uv += [[(0.5, ta), (0.5, tb), (u, tb)], [(0.5, ta), (u, tb), (u, ta)]]
    return surface(np.array(triangles), np.array(uv), green)


def vase(glaze: Material) -> Surfaces:
    outline = [
        (0.045, 0.0),
        (0.085, 0.08),
        (0.09, 0.14),
        (0.05, 0.22),
        (0.035, 0.26),
        (0.05, 0.29),
        (0.042, 0.29),
        (0.03, 0.25),
    ]
    return lathe(outline, glaze, 20)


def bowl_of_fruit(glaze: Material) -> Surfaces:
    parts = [lathe([(0.06, 0.0), (0.15, 0.08), (0.14, 0.08), (0.05, 0.02), (0.0, 0.015)], glaze, 20)]
    for number in range(5):
        yaw = math.radians(72 * number)
        fruit = material("clay" if number % 2 else "ochre_cloth", 0.2)
        parts.append(cushion((0.08, 0.08, 0.08), 0.04, fruit, (0.065 * math.cos(yaw), 0.065 * math.sin(yaw), 0.04)))
    return join(parts)


def plate(glaze: Material) -> Surfaces:
    return lathe([(0.07, 0.0), (0.13, 0.02), (0.128, 0.024), (0.07, 0.006), (0.0, 0.006)], glaze, 20)


def parcel(size: tuple[float, float, float]) -> Surfaces:
    return box(size, material("cardboard", 0.55), without="z")


def picture(width: float, height: float, which: int) -> Surfaces:
    """Framed painting that hangs with its back on y = 0, centred on the origin."""
    frame = material("walnut", 0.3)
    edge, x, z = 0.03, width / 2, height / 2
    u, v = (which % 2) / 2, (which // 2 % 2) / 2
    corners = [(x, 0.02, -z), (-x, 0.02, -z), (-x, 0.02, z), (x, 0.02, z)]
    parts = [quad(corners, material("pictures"), (u, v, u + 0.5, v + 0.5))]
    parts += [box((width + 2 * edge, 0.035, edge), frame, (0, 0.0175, end), without="y") for end in (-z - edge, z)]
    for side in (-1, 1):
        parts.append(box((edge, 0.035, height), frame, (side * (x + edge / 2), 0.0175, -z), without="yzZ"))
    return join(parts)
