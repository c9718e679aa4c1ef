"""Random furnished rooms in the walls of the living room: how well a swarm maps must not hang on one room.

A seed decides all: which furniture stands where, of what size, wood and cloth, and how its textures are drawn.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sim_bridge.scenes import furniture as f
from sim_bridge.scenes.arrangement import Piece, fits, piece
from sim_bridge.scenes.living_room import WALL_M, shell
from sim_bridge.scenes.surfaces import Material, Surfaces, box, join, quad
from sim_bridge.scenes.textures import Image, draw_textures

FURNISHED_M = 2.97
"""Furniture stands within +- this, inside the paper's target box of +-3 m."""
ATTEMPTS = 60
"""Places tried for one piece before it is left out; the room is full then."""
REDRAWS = 10
"""Of a group for which no place was found: a smaller one may fit."""
PARCELS_MOST = 4
WOODS = ("walnut", "birch", "cherry", "painted")
CLOTHS = ("blue_cloth", "ochre_cloth", "linen", "tartan", "zigzag")
WALLS = ("wallpaper", "linen", "painted", "clay")

_Make = Callable[[np.random.Generator], list[Piece]]


def random_room(seed: int) -> tuple[Surfaces, list[Image]]:
    """Surfaces without light, and the images that they use."""
    walls, furniture = _room(seed)
    return join([walls, *(placed.surfaces for placed in furniture)]), draw_textures(seed)


def furniture_of(seed: int) -> list[Piece]:
    """What stands in the room, as `furnish` says."""
    return _room(seed)[1]


def _room(seed: int) -> tuple[Surfaces, list[Piece]]:
    rng = np.random.default_rng(seed)
    walls = shell(f.material(_one_of(rng, WALLS), float(rng.uniform(1.2, 2.2))), _pictures(rng))
    return walls, furnish(rng)


def furnish(rng: np.random.Generator) -> list[Piece]:
    """All furniture at its place, no two pieces overlapping; rugs lie below others and are named so."""
    placed: list[Piece] = []
    along_walls: list[_Make] = [_wardrobe, _bookshelf, _sideboard, _plant, _lamp]
    groups: list[_Make] = [_sitting_group, _dining_group]
    rng.shuffle(groups)
    for make in groups:
        any(_place(make(rng), placed, rng, _anywhere) for _ in range(REDRAWS))
    for number in rng.permutation(len(along_walls)):
        for _ in range(int(rng.integers(1, 3))):
            _place(along_walls[number](rng), placed, rng, _at_a_wall)
    for _ in range(int(rng.integers(2, PARCELS_MOST + 1))):
        _place(_parcels(rng), placed, rng, _anywhere)
    return [*placed, *_rug(rng)]


def _place(
    group: list[Piece],
    placed: list[Piece],
    rng: np.random.Generator,
    somewhere: Callable[[list[Piece], np.random.Generator], list[Piece]],
) -> bool:
    for _ in range(ATTEMPTS):
        tried = somewhere(group, rng)
        if fits(tried, placed, FURNISHED_M):
            placed += tried
            return True
    return False


def _anywhere(group: list[Piece], rng: np.random.Generator) -> list[Piece]:
    x, y = (float(value) for value in rng.uniform(-FURNISHED_M, FURNISHED_M, 2))
    yaw = 90.0 * float(rng.integers(4)) + float(rng.uniform(-20, 20))
    return [each.moved(x, y, yaw) for each in group]


def _at_a_wall(group: list[Piece], rng: np.random.Generator) -> list[Piece]:
    """Its back to one of the four walls."""
    back = min(float(each.footprint[:, 1].min()) for each in group)
    x, wall = float(rng.uniform(-FURNISHED_M, FURNISHED_M)), 90.0 * float(rng.integers(4))
    away = float(rng.uniform(0.0, 0.04)) + 1e-6  # rounding must not carry it out of the room
    return [each.moved(x, away - FURNISHED_M - back).moved(yaw_deg=wall) for each in group]


def _sitting_group(rng: np.random.Generator) -> list[Piece]:
    """A sofa, a low table before it and up to two armchairs that face it."""
    cloth, cover = _cloth(rng), _cloth(rng)
    seats = int(rng.integers(2, 4))
    pillows = [
        f.pillow(cover).moved((seat - (seats - 1) / 2) * 0.62, 0.0, 0.46, float(rng.uniform(-10, 10)))
        for seat in range(seats)
        if rng.random() < 0.6
    ]
    sofa = piece("sofa", join([f.sofa(seats, cloth, _cloth(rng) if rng.random() < 0.5 else None), *pillows]))
    length, width, height = (float(rng.uniform(*span)) for span in ((0.8, 1.2), (0.5, 0.7), (0.36, 0.46)))
    table = piece("coffee table", join([f.table(length, width, height, _wood(rng)), *_laid(rng, length, height)]))
    before = 0.44 + 0.35 + width / 2
    group = [sofa, table.moved(float(rng.uniform(-0.2, 0.2)), before, float(rng.uniform(-6, 6)))]
    for side in (-1, 1):
        if rng.random() < 0.7:
            chair = piece("armchair", f.sofa(1, _cloth(rng)))
            yaw = 180.0 + side * float(rng.uniform(-15, 25))
            group.append(chair.moved(side * 0.62, before + width / 2 + 0.9, yaw))
    return _centred(group)


def _dining_group(rng: np.random.Generator) -> list[Piece]:
    """A table with chairs along both long sides, for four or six."""
    wood, cloth, glaze = _wood(rng), _cloth(rng), f.material("glaze", 0.25)
    places = int(rng.integers(2, 4))
    length, width, height = places * 0.62 + 0.25, float(rng.uniform(0.75, 0.95)), 0.75
    laid, chairs = [f.table(length, width, height, wood)], []
    for place in range(places):
        x = (place - (places - 1) / 2) * 0.62
        for side in (-1, 1):
            if rng.random() < 0.85:
                yaw = (0 if side < 0 else 180) + float(rng.uniform(-12, 12))
                chair = piece("chair", f.chair(wood, cloth))
                chairs.append(chair.moved(x, side * (width / 2 + float(rng.uniform(0.36, 0.5))), yaw))
            laid.append(f.plate(glaze).moved(x, side * (width / 2 - 0.17), height))
    vase = f.vase(f.material(_one_of(rng, ("clay", "glaze")), 0.3))
    laid += [vase.moved(0.05, 0.0, height), f.bowl_of_fruit(glaze).moved(-0.4, 0.0, height)]
    return _centred([piece("dining table", join(laid)), *chairs])


def _wardrobe(rng: np.random.Generator) -> list[Piece]:
    size = (float(rng.uniform(0.9, 1.5)), float(rng.uniform(0.5, 0.62)), float(rng.uniform(1.6, 1.94)))
    return [piece("wardrobe", f.wardrobe(*size, _wood(rng), _wood(rng)))]


def _bookshelf(rng: np.random.Generator) -> list[Piece]:
    size = (float(rng.uniform(0.8, 1.6)), float(rng.uniform(0.26, 0.34)), float(rng.uniform(1.4, 1.95)))
    return [piece("bookshelf", f.bookshelf(*size, _wood(rng), rng))]


def _sideboard(rng: np.random.Generator) -> list[Piece]:
    width, depth, height = (float(rng.uniform(*span)) for span in ((1.2, 1.8), (0.38, 0.48), (0.55, 0.85)))
    board = f.sideboard(width, depth, height, _wood(rng), _wood(rng))
    return [piece("sideboard", join([board, *_laid(rng, width, height)]))]


def _plant(rng: np.random.Generator) -> list[Piece]:
    return [piece("plant", f.plant(rng, float(rng.uniform(0.9, 1.4))))]


def _lamp(rng: np.random.Generator) -> list[Piece]:
    return [piece("lamp", f.floor_lamp().moved(yaw_deg=float(rng.uniform(0, 360))))]


def _parcels(rng: np.random.Generator) -> list[Piece]:
    """One parcel, or a smaller one on top of it."""
    size = (float(rng.uniform(0.35, 0.65)), float(rng.uniform(0.3, 0.5)), float(rng.uniform(0.25, 0.45)))
    stack = [f.parcel(size)]
    if rng.random() < 0.5:
        share = float(rng.uniform(0.55, 0.75))
        upper = f.parcel((size[0] * share, size[1] * share, size[2] * share))
        stack.append(upper.moved(0, 0, size[2], float(rng.uniform(-20, 20))))
    return [piece("parcels", join(stack))]


def _rug(rng: np.random.Generator) -> list[Piece]:
    """One rug near the middle: two would lie in each other."""
    x, y, thick = float(rng.uniform(0.8, 1.4)), float(rng.uniform(0.7, 1.0)), 0.012
    pile = quad([(-x, -y, thick), (x, -y, thick), (x, y, thick), (-x, y, thick)], f.material("rug"), (0, 0, 1, 1))
    rug = piece("rug", join([box((2 * x, 2 * y, thick), _cloth(rng), without="zZ"), pile]))
    return [rug.moved(float(rng.uniform(-1, 1)), float(rng.uniform(-1, 1)), float(rng.uniform(0, 180)))]


def _laid(rng: np.random.Generator, length: float, height: float) -> list[Surfaces]:
    """Small things along a top of ``length``, each in its own third."""
    things = [
        f.stack_of_books(int(rng.integers(3, 6)), rng),
        f.vase(f.material(_one_of(rng, ("clay", "glaze")), 0.3)),
        f.bowl_of_fruit(f.material("painted", 0.3)),
    ]
    order = rng.permutation(len(things))
    return [things[which].moved((place - 1) * length * 0.32, 0.0, height) for place, which in enumerate(order)]


def _pictures(rng: np.random.Generator) -> list[Surfaces]:
    walls = []
    for _ in range(4):
        hung = []
        for x in (-2.1, -0.1, 2.0):
            width, height = float(rng.uniform(0.5, 1.0)), float(rng.uniform(0.45, 0.8))
            framed = f.picture(width, height, which=int(rng.integers(4))).moved(yaw_deg=180)
            hung.append(framed.moved(x + float(rng.uniform(-0.3, 0.3)), WALL_M, float(rng.uniform(1.4, 1.7))))
        walls.append(join(hung))
    return walls


def _centred(group: list[Piece]) -> list[Piece]:
    corners = np.concatenate([each.footprint for each in group])
    x, y = (float(value) for value in (corners.min(axis=0) + corners.max(axis=0)) / 2)
    return [each.moved(-x, -y) for each in group]


def _one_of(rng: np.random.Generator, names: tuple[str, ...]) -> str:
    return names[int(rng.integers(len(names)))]


def _wood(rng: np.random.Generator) -> Material:
    return f.material(_one_of(rng, WOODS), float(rng.uniform(0.7, 1.1)))


def _cloth(rng: np.random.Generator) -> Material:
    return f.material(_one_of(rng, CLOTHS), float(rng.uniform(0.4, 0.7)))
