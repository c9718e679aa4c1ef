"""The picture of docs/obstacles.md: one room, flown with obstacle rows and without, cut at the height of its furniture.

    PYTHONPATH=.:tests .venv/bin/python -m faults.obstacle_picture [--room N] [--folder FOLDER] [--height METRES]

The flights are those of `faults.obstacle_study` in FOLDER; what is not there is flown first. What was free by the map
is read from the flight's last checkpoint, so it is a few seconds older than the paths' ends.
"""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray
from PIL import Image

from faults.obstacle_study import SECONDS, fly
from ground_station.checkpoint import load_checkpoint
from ground_station.flown_mission import read_mission
from ground_station.palette import drone_colour
from ground_station.reconstruction.backends import make_reconstructor
from protocol.geometry import Floats
from protocol.mission import Mission
from protocol.obstacle_grid import Cells, ObstacleGrid
from sim_bridge.contacts import Contacts
from sim_bridge.scenes.cache import scene_cache
from sim_bridge.scenes.scene import load_scene

PICTURE = Path("docs/images/obstacles.png")
INCHES, DPI = (11.0, 5.9), 110
COLOURS = 256
HEIGHT_M = 1.0
NEAR_M = 0.4
"""From the cut: a path so near to it is drawn thick, because it goes around what is drawn, or into it."""
FREE, NOT_FREE, FURNITURE, INK = "#ffffff", "#f6d5d0", "#5b4a42", "#1f2933"
CONTACT = "#c62828"


def cut(triangles: NDArray[np.float32], height_m: float) -> Floats:
    """(n, 2, 2) where a level plane cuts triangles (T, 3, 3)."""
    tall = triangles[(triangles[..., 2].min(axis=1) < height_m) & (triangles[..., 2].max(axis=1) > height_m)]
    corners = tall.astype(float)
    ends = []
    for one, other in ((0, 1), (1, 2), (2, 0)):
        low, high = corners[:, one], corners[:, other]
        crosses = (low[:, 2] < height_m) != (high[:, 2] < height_m)
        share = (height_m - low[:, 2]) / np.where(crosses, high[:, 2] - low[:, 2], 1.0)
        place = low[:, :2] + share[:, None] * (high - low)[:, :2]
        ends.append(np.where(crosses[:, None], place, np.nan))
    found = np.stack(ends, axis=1)
    return found[np.isfinite(found[..., 0])].reshape(-1, 2, 2)


def seen_free(mission: Mission, run: Path) -> tuple[ObstacleGrid, Cells, int]:
    """The lattice, what the map and the mission say is free, and at which tick."""
    checkpoint = load_checkpoint(run, mission)
    if checkpoint is None:
        raise SystemExit(f"{run}: has no checkpoint")
    reconstructor = make_reconstructor(mission)
    reconstructor.restore(checkpoint.map.reconstruction, ())
    grid = ObstacleGrid.of(mission)
    return grid, reconstructor.free_cells(grid), checkpoint.tick


def touches(mission: Mission, triangles: NDArray[np.float32], paths: Floats) -> Floats:
    """(n, 3): where a drone began to touch something; ``paths`` (ticks, drones, 3)."""
    contacts, found = Contacts(mission, triangles), []
    for places in paths:
        before = dict(contacts.counts)
        flown = dict(zip(before, places, strict=True))
        contacts.note({drone: place for drone, place in flown.items() if np.isfinite(place).all()})
        found += [flown[drone] for drone, count in contacts.counts.items() if count > before[drone]]
    return np.array(found).reshape(-1, 3)


def draw(axes: Axes, mission: Mission, run: Path, height_m: float) -> None:
    """One flight, from above."""
    triangles = load_scene(mission.simulation.scene, relative_to=run, cache=scene_cache()).triangles
    with np.load(run / "trajectories.npz") as flown:
        paths = flown["poses"][..., :3]
    obstacles = mission.flight.obstacles.enabled
    if obstacles:
        grid, free, tick = seen_free(mission, run)
        level = int((height_m - grid.origin[2]) / grid.cell_m)
        corners = [(low, low + grid.cell_m * count) for low, count in zip(grid.origin, grid.shape, strict=True)]
        rgb = [tuple(bytes.fromhex(colour[1:])) for colour in (NOT_FREE, FREE)]
        axes.imshow(
            np.array(rgb, np.uint8)[free[:, :, level].T.astype(int)],
            origin="lower",
            extent=(*corners[0], *corners[1]),
            interpolation="nearest",
        )
    for (x, y), (other_x, other_y) in cut(triangles, height_m):
        axes.plot([x, other_x], [y, other_y], color=FURNITURE, linewidth=1.6, solid_capstyle="round", zorder=2)
    for index in range(paths.shape[1]):
        path = paths[:, index]
        near = np.abs(path[:, 2:] - height_m) < NEAR_M
        axes.plot(*path[:, :2].T, color=drone_colour(index), linewidth=0.6, alpha=0.55, zorder=3)
        axes.plot(*np.where(near, path[:, :2], np.nan).T, color=drone_colour(index), linewidth=1.8, zorder=4)
    met = touches(mission, triangles, paths)
    axes.scatter(*met[:, :2].T, s=150, marker="X", color=CONTACT, edgecolors="white", linewidths=1.0, zorder=6)
    title = f"with obstacle rows: {len(met)} contacts" if obstacles else f"without: {len(met)} contacts"
    axes.set_title(title, fontweight="bold", color=INK if not len(met) else CONTACT)
    if obstacles:
        axes.set_xlabel(f"what {tick * mission.tick_s:.0f} s of flight have seen free at {height_m:g} m", color=INK)
    else:
        axes.set_xlabel("no drone knows what is free", color=INK)
    walls = max(map(abs, np.ravel(mission.flight.boundary or 3.4))) + 0.25
    axes.set(xlim=(-walls, walls), ylim=(-walls, walls), xticks=[], yticks=[], aspect="equal")


def main(arguments: Sequence[str]) -> None:
    parser = argparse.ArgumentParser(prog="faults.obstacle_picture")
    parser.add_argument("--room", type=int, default=1)
    parser.add_argument("--folder", type=Path, default=Path("obstacle-study"))
    parser.add_argument("--height", type=float, default=HEIGHT_M, help="of the cut, metres")
    parser.add_argument("--out", type=Path, default=PICTURE)
    asked = parser.parse_args(arguments)
    figure = Figure(INCHES, layout="constrained")
    for axes, enabled in zip(figure.subplots(1, 2), (False, True), strict=True):
        fly(asked.room, enabled=enabled, seconds=SECONDS, folder=asked.folder)
        run = asked.folder / f"room-{asked.room}-{'with' if enabled else 'without'}" / "latest"
        draw(axes, read_mission(run), run.resolve(), asked.height)
    handles = [
        Patch(facecolor=NOT_FREE, label="not free: a thing, or not seen"),
        Line2D([], [], color=FURNITURE, linewidth=1.6, label=f"furniture and walls at {asked.height:g} m"),
        Line2D([], [], color=drone_colour(0), linewidth=1.8, label=f"a drone within {NEAR_M:g} m of that height"),
        Line2D([], [], color=drone_colour(0), linewidth=0.6, alpha=0.55, label="above or below"),
        Line2D(
            [], [], marker="X", color=CONTACT, markeredgecolor="white", markersize=11, linestyle="", label="contact"
        ),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    pixels = io.BytesIO()
    figure.savefig(pixels, dpi=DPI)
    Image.open(pixels).convert("RGB").quantize(COLOURS).save(asked.out, optimize=True)
    print(asked.out)


if __name__ == "__main__":
    main(sys.argv[1:])
