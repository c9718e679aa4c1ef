"""A furnished living room that fills the paper's box [-3, 3] x [-3, 3] x [0, 2] m.

Made here rather than downloaded: no licence to mind, no file to ship, the same bytes everywhere. Tall furniture
stands at the edges of the box, where drones that see it from 1 m away keep clear of it; walls at +-3.5 m are drawn
from inside only; there is no ceiling.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sim_bridge.scenes import furniture as f
from sim_bridge.scenes.arrangement import Piece, piece
from sim_bridge.scenes.surfaces import Material, Surfaces, box, join, quad
from sim_bridge.scenes.textures import TEXTURE, Image, draw_textures

SEED = 20
WALL_M = 3.5
WALL_HEIGHT_M = 2.5
OUTSIDE_M = 14.0
"""The paving outside reaches so far: a camera at the flight region's corner still sees ground."""


def living_room() -> tuple[Surfaces, list[Image]]:
    """Surfaces without light, and the images that they use."""
    walls = shell(f.material("wallpaper", 2.0), _pictures())
    return join([walls, *(each.surfaces for each in furnish())]), draw_textures(SEED)


def furnish() -> list[Piece]:
    """All furniture at its place."""
    rng = np.random.default_rng(SEED)
    return [*_sitting_area(rng), *_dining_area(), *_edges(rng)]


def shell(wall: Material, pictures: Sequence[Surfaces]) -> Surfaces:
    """Floor, walls and the paving outside; ``pictures`` are what hangs on each wall, as if it were the one at +y."""
    w, h, out = WALL_M, WALL_HEIGHT_M, OUTSIDE_M
    floor = Material(TEXTURE["floorboards"])
    paving, trim = f.material("paving", 2.4), f.material("painted", 0.8)
    parts = [quad([(-w, -w, 0), (w, -w, 0), (w, w, 0), (-w, w, 0)], floor, (0, 0, 1, 1))]
    parts.append(quad([(-out, -out, 0), (out, -out, 0), (out, -w, 0), (-out, -w, 0)], paving))
    parts.append(quad([(-out, w, 0), (out, w, 0), (out, out, 0), (-out, out, 0)], paving))
    parts.append(quad([(-out, -w, 0), (-w, -w, 0), (-w, w, 0), (-out, w, 0)], paving))
    parts.append(quad([(w, -w, 0), (out, -w, 0), (out, w, 0), (w, w, 0)], paving))
    side = quad([(-w, w, 0), (w, w, 0), (w, w, h), (-w, w, h)], wall)
    skirting = box((2 * w, 0.02, 0.09), trim, (0, w - 0.01, 0), without="zY")
    for number, hung in enumerate(pictures):
        parts += [part.moved(yaw_deg=90 * number) for part in (side, skirting, hung)]
    return join(parts)


def _pictures() -> list[Surfaces]:
    walls = []
    for number in range(4):
        hung = []
        for place, x in enumerate((-1.9, 0.2, 2.0)):
            size = ((0.7, 0.5), (0.55, 0.75), (0.9, 0.6))[(place + number) % 3]
            hung.append(f.picture(*size, which=place + number).moved(yaw_deg=180).moved(x, WALL_M, 1.55))
        walls.append(join(hung))
    return walls


def _sitting_area(rng: np.random.Generator) -> list[Piece]:
    blue, ochre = f.material("blue_cloth", 0.5), f.material("ochre_cloth", 0.5)
    zigzag, tartan = f.material("zigzag", 0.45), f.material("tartan", 0.6)
    rug = box((2.6, 1.9, 0.012), f.material("linen", 0.3), without="zZ")
    pile = quad(
        [(-1.3, -0.95, 0.012), (1.3, -0.95, 0.012), (1.3, 0.95, 0.012), (-1.3, 0.95, 0.012)],
        f.material("rug"),
        (0, 0, 1, 1),
    )
    sofa = join([
        f.sofa(3, blue, tartan),
        f.pillow(zigzag).moved(-0.75, 0.0, 0.46, 8),
        f.pillow(ochre).moved(-0.27, 0.0, 0.46, -6),
    ])  # fmt: skip
    armchair = join([f.sofa(1, ochre), f.pillow(tartan).moved(0.04, 0.0, 0.46, 5)])
    coffee_table = join([
        f.table(1.1, 0.6, 0.42, f.material("birch", 0.9)),
        f.stack_of_books(4, rng).moved(-0.32, 0.05, 0.42, 15),
        f.vase(f.material("glaze", 0.3)).moved(0.36, 0.12, 0.42),
        f.bowl_of_fruit(f.material("painted", 0.3)).moved(0.05, -0.08, 0.42),
    ])  # fmt: skip
    return [
        piece("rug", join([rug, pile])).moved(-1.1, 0.4, 86),
        piece("sofa", sofa).moved(-2.45, 0.5, -90),
        piece("coffee table", coffee_table).moved(-1.15, 0.45, 84),
        piece("armchair", armchair).moved(-0.95, -1.45, 12),
        piece("armchair", f.sofa(1, f.material("tartan", 0.7))).moved(-0.7, 2.25, 168),
    ]


def _dining_area() -> list[Piece]:
    cherry, cloth = f.material("cherry", 1.1), f.material("blue_cloth", 0.4)
    glaze = f.material("glaze", 0.25)
    runner = box((1.3, 0.34, 0.004), f.material("zigzag", 0.5), (0, 0, 0.75), without="z")
    laid = [f.table(1.6, 0.9, 0.75, cherry), runner, f.vase(f.material("clay", 0.3)).moved(0.05, 0.02, 0.754)]
    chairs = []
    for x in (-0.45, 0.45):
        for side, yaw in ((-1, 0), (1, 180)):
            chair = f.chair(f.material("cherry", 0.7), cloth).moved(yaw_deg=yaw + 9 * x).moved(x, side * 0.62)
            chairs.append(piece("chair", chair))
            laid.append(f.plate(glaze).moved(x * 1.05, side * 0.3, 0.75))
    laid.append(f.stack_of_books(3, np.random.default_rng(SEED + 1)).moved(-0.62, 0.02, 0.754, 70))
    return [each.moved(1.35, -0.9, 78) for each in (piece("dining table", join(laid)), *chairs)]


def _edges(rng: np.random.Generator) -> list[Piece]:
    walnut, birch, painted = f.material("walnut", 0.9), f.material("birch", 0.9), f.material("painted", 0.7)
    sideboard = join([
        f.sideboard(1.7, 0.42, 0.62, birch, painted),
        f.stack_of_books(5, rng).moved(-0.6, 0.0, 0.62, -12),
        f.vase(f.material("glaze", 0.3)).moved(0.1, 0.02, 0.62),
        f.plant(rng, 0.9).moved(0.6, 0.0, 0.62),
    ])  # fmt: skip
    parcels = join([
        f.parcel((0.6, 0.45, 0.42)).moved(0, 0, 0, 14),
        f.parcel((0.4, 0.35, 0.3)).moved(0.04, 0.02, 0.42, -20),
        f.parcel((0.38, 0.5, 0.28)).moved(-0.62, 0.1, 0, 40),
    ])  # fmt: skip
    return [
        piece("wardrobe", f.wardrobe(1.3, 0.58, 1.92, walnut, painted)).moved(2.62, 1.75, 90),
        piece("bookshelf", f.bookshelf(1.5, 0.3, 1.85, walnut, rng)).moved(0.9, 2.78, 180),
        piece("sideboard", sideboard).moved(-1.4, -2.72),
        piece("parcels", parcels).moved(1.4, 1.2),
        piece("lamp", f.floor_lamp()).moved(-2.55, 2.3),
        piece("plant", f.plant(rng)).moved(2.45, -2.5),
    ]
