"""Pictures of everyday materials, drawn from noise: grain, weave, pattern, print.

Stereo needs contrast at the scale of a few pixels, and no pattern that repeats within a search range; real rooms
have both. Every texture repeats seamlessly at its border unless it is a picture of one thing (rug, books, pictures).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from protocol.geometry import Floats

Image = NDArray[np.uint8]
Colours = Sequence[tuple[float, float, float]]


def noise(rng: np.random.Generator, side: int, roughness: float, stretch: tuple[float, float] = (1.0, 1.0)) -> Floats:
    """Periodic noise [side, side], mean 0, standard deviation 1.

    The amplitude falls with frequency to the power ``roughness``; ``stretch`` draws it out along rows, columns.
    """
    down = np.fft.fftfreq(side)[:, None] * stretch[1]
    across = np.fft.rfftfreq(side)[None] * stretch[0]
    frequency = np.hypot(down, across) + 1.0 / side
    spectrum = np.fft.rfft2(rng.standard_normal((side, side))) / frequency**roughness
    spectrum[0, 0] = 0.0
    field = np.fft.irfft2(spectrum, (side, side))
    return np.asarray((field - field.mean()) / field.std())


def shades(value: Floats, colours: Colours) -> Floats:
    """0..1 to colour, linear between ``colours`` spread evenly; values beyond are clipped."""
    steps = 1024
    grid = np.linspace(0.0, 1.0, steps)
    stops = np.linspace(0.0, 1.0, len(colours))
    table = np.stack([np.interp(grid, stops, [colour[channel] for colour in colours]) for channel in range(3)], axis=-1)
    return table[np.clip(value * (steps - 1), 0, steps - 1).astype(np.int16)]


def _finish(colour: Floats) -> Image:
    return np.clip(np.rint(colour), 0, 255).astype(np.uint8)


def _unit(field: Floats) -> Floats:
    """Standard-normal field to mostly 0..1."""
    return 0.5 + 0.22 * field


def wood(rng: np.random.Generator, colours: Colours, side: int = 512) -> Image:
    """Grain along the rows."""
    warp = noise(rng, side, 1.6, (6.0, 1.0))
    rings = np.arange(side)[:, None] / side * 9.0 * 2 * np.pi + 2.2 * warp
    pores = noise(rng, side, 0.6, (14.0, 0.7))
    value = 0.5 + 0.24 * np.sin(rings) + 0.10 * warp + 0.11 * pores
    return _finish(shades(value, colours))


def floorboards(rng: np.random.Generator, side: int = 2048, rows: int = 40) -> Image:
    """Planks along the rows, each of its own tone, with dark joints; shown once over the whole floor."""
    tile, length = side // 2, side // 6
    grain = 0.5 + 0.10 * noise(rng, tile, 1.4, (10.0, 1.0)) + 0.10 * noise(rng, tile, 0.5, (16.0, 0.8))
    colour = np.zeros((side, side, 3), dtype=np.uint8)
    edges = np.linspace(0, side, rows + 1).astype(int)
    for top, bottom in itertools.pairwise(edges):
        for left in range(-int(rng.integers(length)), side, length):
            y, x = rng.integers(0, tile - (bottom - top)), rng.integers(0, tile - length)
            wood_here = grain[y : y + bottom - top, x : x + length] + rng.uniform(-0.2, 0.2)
            plank = shades(wood_here, [(92, 58, 34), (150, 101, 62), (188, 140, 92), (218, 178, 130)])
            plank[:2], plank[:, :3] = plank[:2] * 0.4, plank[:, :3] * 0.4
            right = min(left + length, side)
            colour[top:bottom, max(left, 0) : right] = plank[:, max(-left, 0) : right - left]
    return colour


def weave(rng: np.random.Generator, dark: Floats, light: Floats, threads: int = 96, side: int = 512) -> Image:
    """Cloth of crossing threads, uneven as spun yarn is."""
    y, x = np.mgrid[0:side, 0:side] / side * threads
    over = (np.floor(x) + np.floor(y)) % 2
    bump = np.where(over, np.sin((x % 1) * np.pi), np.sin((y % 1) * np.pi))
    yarn = rng.normal(0.0, 0.13, (2, threads))
    tone = np.where(over, yarn[0][np.floor(x).astype(int)], yarn[1][np.floor(y).astype(int)])
    value = 0.30 + 0.35 * bump + tone + 0.10 * noise(rng, side, 0.3) + 0.12 * noise(rng, side, 1.3)
    return _finish(shades(value, [tuple(dark), tuple(light)]))


def tartan(rng: np.random.Generator, side: int = 512) -> Image:
    """Checked blanket."""
    stripes = np.empty((side, 3))
    stripes[:] = (150, 40, 42)
    navy, cream, green, yellow = (36, 48, 84), (226, 210, 170), (30, 70, 52), (232, 190, 70)
    for start, width, tone in (
        (0, 60, navy),
        (90, 14, cream),
        (150, 40, green),
        (260, 90, navy),
        (300, 10, cream),
        (400, 50, green),
        (470, 10, yellow),
    ):
        stripes[start : start + width] = tone
    twill = ((np.add.outer(np.arange(side), np.arange(side)) // 4) % 2)[..., None]
    colour = np.where(twill, stripes[None], stripes[:, None]) * (1 + 0.10 * noise(rng, side, 0.4)[..., None])
    return _finish(colour)


def zigzag(rng: np.random.Generator, colours: Colours, side: int = 512) -> Image:
    """Cushion cover with a chevron print."""
    y, x = np.mgrid[0:side, 0:side] / side
    band = (y * 10 + 2 * np.abs((x * 5) % 1 - 0.5)) % len(colours)
    colour = np.array(colours, dtype=np.float64)[band.astype(int)]
    return _finish(colour * (1 + 0.09 * noise(rng, side, 0.4)[..., None]))


def rug(rng: np.random.Generator, width: int = 1024, height: int = 1024) -> Image:
    """Knotted carpet: border, corner pieces, medallion and a field of small flowers."""
    y, x = np.mgrid[0:height, 0:width]
    u, v = x / width * 2 - 1, y / height * 2 - 1
    colour = np.empty((height, width, 3))
    colour[:] = (122, 28, 34)
    navy, cream, gold, teal = (28, 36, 72), (226, 208, 172), (196, 148, 66), (44, 98, 104)
    for _ in range(260):
        size, tone = rng.uniform(0.018, 0.04), (cream, gold, teal, navy)[int(rng.integers(4))]
        half = int(size * height)
        row, column = rng.integers(height // 10, height - height // 10, 2)
        flower = np.s_[row - half : row + half, column - half : column + half]
        dx, dy = (u[flower] - u[row, column]) * 1.4, v[flower] - v[row, column]
        distance = np.hypot(dx, dy) * (1 + 0.3 * np.sin(5 * np.arctan2(dy, dx)))
        colour[flower][distance < size] = tone
        colour[flower][distance < size * 0.45] = (122, 28, 34)
    radius, angle = np.hypot(u * 1.4, v), np.arctan2(v, u * 1.4)
    for petals, size, tone in (
        (12, 0.52, navy),
        (12, 0.46, gold),
        (16, 0.42, (146, 44, 40)),
        (8, 0.30, cream),
        (8, 0.25, teal),
        (6, 0.12, gold),
    ):
        colour[radius < size * (1 + 0.09 * np.cos(petals * angle))] = tone
    corner = np.hypot((1 - np.abs(u)) * 1.4, 1 - np.abs(v)) * (
        1 + 0.08 * np.cos(14 * np.arctan2(1 - np.abs(v), 1 - np.abs(u)))
    )
    colour[corner < 0.52], colour[corner < 0.47] = gold, navy
    margin = np.minimum(1 - np.abs(u), (1 - np.abs(v)) * 1.0)
    along = np.where(1 - np.abs(u) < 1 - np.abs(v), v * 1.0, u * 1.4)
    border = margin < 0.2
    colour[border] = navy
    motif = border & (np.abs(margin - 0.11) < 0.045 * (0.35 + np.abs(np.sin(along * 26))))
    colour[motif] = cream
    colour[motif & (np.abs(margin - 0.11) < 0.02)] = (150, 40, 40)
    colour[(np.abs(margin - 0.2) < 0.012) | (np.abs(margin - 0.025) < 0.012)] = gold
    knots = rng.normal(1.0, 0.13, (height // 2, width // 2)).repeat(2, axis=0).repeat(2, axis=1)
    wear = 1 + 0.07 * noise(rng, height, 1.4)[:, :width]
    return _finish(colour * (knots * wear)[..., None])


def wallpaper(rng: np.random.Generator, side: int = 1024) -> Image:
    """Painted plaster with a stencilled leaf pattern and stains."""
    y, x = np.mgrid[0:side, 0:side] / side * 6
    row = np.floor(y)
    cell_x, cell_y = (x + 0.5 * (row % 2)) % 1 - 0.5, y % 1 - 0.5
    radius, angle = np.hypot(cell_x, cell_y), np.arctan2(cell_y, cell_x)
    leaf = radius < 0.20 * (0.55 + 0.45 * np.abs(np.cos(3 * angle)))
    value = 0.56 + 0.09 * noise(rng, side, 1.3) + 0.05 * noise(rng, side, 0.3) - 0.24 * leaf
    return _finish(shades(value, [(96, 112, 108), (168, 178, 164), (226, 222, 204)]))


def books(rng: np.random.Generator, rows: int = 4, side: int = 1024) -> Image:
    """Rows of book spines, from left to right over the whole width."""
    colour = np.empty((side, side, 3))
    band = side // rows
    for top in range(0, side, band):
        left = 0
        while left < side:
            width = int(rng.integers(18, 52))
            base = np.array(_BOOK_COLOURS[int(rng.integers(len(_BOOK_COLOURS)))]) * rng.uniform(0.75, 1.15)
            ink = np.array((232, 214, 160)) if base.mean() < 120 else np.array((40, 34, 30))
            spine = np.tile(base, (band, min(width, side - left), 1))
            edge = np.abs(np.linspace(-1, 1, width))[: spine.shape[1]]
            spine *= (1.05 - 0.45 * edge**4)[None, :, None]
            for line in rng.integers(8, band - 8, int(rng.integers(1, 5))):
                spine[line : line + int(rng.integers(2, 7))] = ink
            start = int(rng.integers(band // 5, band // 3))
            for line in range(start, start + int(rng.integers(band // 4, band // 2)), 6):
                # Letters of a title that runs down the spine.
                inner = slice(width // 4, max(width // 4 + 2, width - width // 4))
                spine[line : line + 4, inner][rng.random(spine[line : line + 4, inner].shape[:2]) < 0.6] = ink
            colour[top : top + band, left : left + width] = spine
            left += width
    return _finish(colour * (1 + 0.05 * noise(rng, side, 0.5)[..., None]))


def pictures(rng: np.random.Generator, side: int = 1024) -> Image:
    """Two by two paintings: a landscape, discs, a grid, brush strokes."""
    half = side // 2
    y, x = np.mgrid[0:half, 0:half] / half
    hills = np.tile(shades(y, [(250, 214, 150), (214, 120, 90), (120, 90, 120)]), (1, 1, 1))
    for level, tone in ((0.45, (88, 96, 120)), (0.6, (52, 84, 80)), (0.75, (34, 58, 44))):
        ridge = level + 0.09 * np.sin(x * 7 + level * 30) + 0.04 * noise(rng, half, 1.6)[0][None]
        hills[y > ridge] = tone
    hills[np.hypot(x - 0.7, y - 0.25) < 0.08] = (255, 244, 210)
    discs = np.full((half, half, 3), (236, 226, 206), dtype=np.float64)
    for _ in range(26):
        centre, size = rng.random(2), rng.uniform(0.04, 0.16)
        discs[np.hypot(x - centre[0], y - centre[1]) < size] = _BOOK_COLOURS[int(rng.integers(len(_BOOK_COLOURS)))]
    cells = rng.integers(0, len(_BOOK_COLOURS), (7, 7))
    grid = np.array(_BOOK_COLOURS, dtype=np.float64)[cells[(y * 7).astype(int), (x * 7).astype(int)]]
    grid[((y * 7) % 1 < 0.08) | ((x * 7) % 1 < 0.08)] = (24, 22, 24)
    strokes = shades(
        _unit(noise(rng, half, 1.5, (5.0, 1.0))), [(20, 40, 80), (70, 130, 170), (240, 236, 220), (220, 120, 50)]
    )
    canvas = np.concatenate([np.concatenate([hills, discs], 1), np.concatenate([grid, strokes], 1)])
    return _finish(canvas * (1 + 0.05 * noise(rng, side, 0.5)[..., None]))


def speckle(rng: np.random.Generator, colours: Colours, roughness: float = 0.8, side: int = 512) -> Image:
    """Stone, clay, metal, soil: noise of many sizes."""
    return _finish(shades(_unit(noise(rng, side, roughness)), colours))


def leaf(rng: np.random.Generator, side: int = 256) -> Image:
    """One leaf with its veins; the stem runs along the columns."""
    y, x = np.mgrid[0:side, 0:side] / side
    veins = np.abs(((y + 0.6 * np.abs(x - 0.5)) * 9) % 1 - 0.5) > 0.42
    value = _unit(noise(rng, side, 1.0)) * 0.7 + 0.15
    colour = shades(value, [(24, 58, 24), (58, 112, 42), (120, 166, 72)])
    colour[veins | (np.abs(x - 0.5) < 0.03)] *= 1.45
    return _finish(colour)


def cardboard(rng: np.random.Generator, side: int = 512) -> Image:
    """Parcel: corrugation, a label, print and a strip of tape."""
    y, x = np.mgrid[0:side, 0:side] / side
    value = 0.5 + 0.10 * np.sin(x * 2 * np.pi * 64) + 0.14 * noise(rng, side, 0.9)
    colour = shades(value, [(128, 92, 56), (176, 136, 90), (208, 172, 124)])
    colour[np.abs(y - 0.12) < 0.05] = (214, 196, 150)
    label = (np.abs(x - 0.28) < 0.17) & (np.abs(y - 0.55) < 0.13)
    colour[label] = (238, 236, 228)
    bars = rng.random(64) < 0.5
    colour[label & (y > 0.56) & bars[(x * 150).astype(int) % 64]] = (24, 24, 28)
    print_block = (np.abs(x - 0.74) < 0.12) & (np.abs(y - 0.6) < 0.2) & ((y * 24) % 1 < 0.45)
    colour[print_block] = (60, 40, 34)
    return _finish(colour)


def tiles(rng: np.random.Generator, side: int = 512, count: int = 8) -> Image:
    """Paving outside the room."""
    y, x = np.mgrid[0:side, 0:side] / side * count
    tone = rng.normal(0, 0.12, (count, count))[y.astype(int), x.astype(int)]
    value = 0.5 + tone + 0.14 * noise(rng, side, 0.9)
    value[((x % 1) < 0.05) | ((y % 1) < 0.05)] -= 0.35
    return _finish(shades(value, [(54, 56, 58), (128, 128, 122), (190, 188, 178)]))


_BOOK_COLOURS: Colours = (
    (140, 36, 36), (30, 60, 110), (34, 88, 60), (206, 170, 80), (90, 50, 100), (218, 210, 190), (40, 40, 46),
    (190, 96, 48), (70, 130, 140), (150, 120, 90), (226, 226, 224), (112, 24, 60),
)  # fmt: skip
_WALNUT: Colours = ((48, 28, 18), (86, 54, 34), (128, 86, 54), (164, 118, 76))
_BIRCH: Colours = ((150, 112, 70), (198, 162, 112), (222, 192, 146), (240, 218, 178))
_CHERRY: Colours = ((74, 28, 14), (124, 58, 30), (166, 90, 50), (196, 124, 78))
_PAINTED: Colours = ((84, 106, 108), (140, 160, 156), (178, 192, 184), (206, 214, 204))

RECIPES: dict[str, Callable[[np.random.Generator], Image]] = {
    "floorboards": floorboards,
    "rug": rug,
    "wallpaper": wallpaper,
    "walnut": lambda rng: wood(rng, _WALNUT),
    "birch": lambda rng: wood(rng, _BIRCH),
    "cherry": lambda rng: wood(rng, _CHERRY),
    "painted": lambda rng: wood(rng, _PAINTED),
    "blue_cloth": lambda rng: weave(rng, np.array((24, 40, 66)), np.array((128, 158, 190))),
    "ochre_cloth": lambda rng: weave(rng, np.array((104, 66, 18)), np.array((232, 186, 92)), 72),
    "linen": lambda rng: weave(rng, np.array((140, 126, 104)), np.array((250, 240, 216)), 64),
    "tartan": tartan,
    "zigzag": lambda rng: zigzag(rng, ((206, 84, 52), (240, 226, 196), (44, 92, 98), (240, 226, 196))),
    "books": books,
    "pictures": pictures,
    "metal": lambda rng: speckle(rng, ((36, 38, 42), (86, 90, 96), (150, 152, 156)), 0.6),
    "clay": lambda rng: speckle(rng, ((118, 54, 34), (176, 92, 60), (212, 136, 98))),
    "glaze": lambda rng: speckle(rng, ((30, 64, 92), (110, 150, 170), (236, 236, 226)), 1.2),
    "soil": lambda rng: speckle(rng, ((22, 16, 12), (62, 46, 34), (110, 90, 70)), 0.4),
    "leaf": leaf,
    "cardboard": cardboard,
    "paving": tiles,
}
TEXTURE = {name: index for index, name in enumerate(RECIPES)}


def draw_textures(seed: int) -> list[Image]:
    """All images in the order of ``TEXTURE``; each has its own stream, so that one can change without the others."""
    return [draw(np.random.default_rng([seed, index])) for index, draw in enumerate(RECIPES.values())]
