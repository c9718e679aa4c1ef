"""Final meshes side by side, all in the same frame, the scene itself first."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ground_station.mesh_files import read_ply
from ground_station.report.picture import Picture, oblique_view
from ground_station.report.run_data import Mesh
from ground_station.report.run_folder import load_run
from ground_station.study import paper
from ground_station.study.drawings import pictures
from ground_station.study.flown import Flown, by_series
from ground_station.study.plan_file import TRUTH_MESH_FILE

TILE_PX = (620, 420)
"""Width and height."""
COLUMNS = 4


def draw_meshes(flights: list[Flown], stem: Path) -> list[Path]:
    """Of each series the first seed's, with its F of visible surface and of objects; series without a map left out."""
    tiles: dict[str, Picture] = {}
    frame = None
    for series, flown in by_series(flights).items():
        first = flown[0]
        truth, mesh = truth_of(first.folder), first.mesh()
        if frame is None:
            frame = corners_of(first.folder)
            if truth is not None:
                tiles["the scene"] = oblique_view(truth, *TILE_PX, framed=frame)
        if mesh is not None:
            scores = ", ".join(f"{first.figures[key]:.3f}" for key in ("f_visible", "f_objects"))
            tiles[f"{paper.label(*series[1:])}\nF {scores}"] = oblique_view(mesh, *TILE_PX, framed=frame)
    return pictures(tiles, stem, COLUMNS) if tiles else []


def corners_of(folder: Path) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """(8, 3), of the target box."""
    target = load_run(folder).mission.target
    ends = zip(target.lower_m, target.upper_m, strict=True)
    return np.stack(np.meshgrid(*ends), axis=-1).reshape(-1, 3).astype(np.float32)


def truth_of(folder: Path) -> Mesh | None:
    path = folder / TRUTH_MESH_FILE
    if not path.exists():
        return None
    found = read_ply(path.read_bytes(), str(path))
    return Mesh(found.vertices, found.faces, found.colors)
