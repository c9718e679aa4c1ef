"""Where a map is wrong and where it lacks something: both surfaces in the colours of their distance to the other."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ground_station.evaluate.figures import distances_to
from ground_station.evaluate.reference import Reference
from ground_station.evaluation import Faces, Vertices
from ground_station.mesh_files import Colours
from ground_station.report.figures import STYLE
from ground_station.report.picture import Picture, oblique_view
from ground_station.report.run_data import Mesh

COLOUR_MAP: Final = "turbo"
"""Of matplotlib: blue near, red far; both are told apart also where a surface is in shade."""
WORST: Final = 2.0
"""Distances from this many thresholds on have the last colour."""
EDGE_M: Final = 0.08
"""Longest edge of the true surface's triangles once they are coloured: half a chair's seat."""
TRIANGLES_PER_EDGE2: Final = 6
"""About so many come of a square of that edge, for triangles are halved until the longest edge fits."""
MOST_TRIANGLES: Final = 3_000_000
"""Of a true surface that is split so; a larger one is coloured as it is."""
TILE_PX: Final = (900, 620)
TILE_INCHES: Final = (7.2, 5.0)
DPI: Final = 130


def coloured(distances: NDArray[np.float32], threshold_m: float) -> Colours:
    """(N, 3), by distances in metres (N,)."""
    from matplotlib import colormaps

    shown = colormaps[COLOUR_MAP](np.clip(distances / (WORST * threshold_m), 0, 1), bytes=True)
    colours: Colours = np.asarray(shown, dtype=np.uint8)[:, :3]
    return colours


def error_mesh(vertices: Vertices, faces: Faces, reference: Reference, threshold_m: float) -> Mesh:
    """The map in the colours of its distance to the true surface."""
    return Mesh(vertices, faces, coloured(distances_to(vertices, reference.vertices, reference.faces), threshold_m))


def missing_mesh(vertices: Vertices, faces: Faces, reference: Reference, threshold_m: float) -> Mesh:
    """The true surface in the colours of its distance to the map, its triangles split to show more than corners."""
    fine = _split(reference.vertices, reference.faces)
    return Mesh(*fine, coloured(distances_to(fine[0], vertices, faces), threshold_m))


def draw_errors(wrong: Mesh, missing: Mesh, reference: Reference, threshold_m: float, file: Path) -> None:
    """Both side by side, seen from the same corner, with the scale of their colours; as PNG.

    Raises OSError.
    """
    from matplotlib import style
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    ends = zip(reference.box.lower_m, reference.box.upper_m, strict=True)
    frame = np.stack(np.meshgrid(*ends), axis=-1).reshape(-1, 3).astype(np.float32)
    tiles: dict[str, Picture] = {
        "the map, by its distance to the true surface": oblique_view(wrong, *TILE_PX, framed=frame),
        "the true surface, by its distance to the map": oblique_view(missing, *TILE_PX, framed=frame),
    }
    with style.context(STYLE):
        figure = Figure(figsize=(TILE_INCHES[0] * len(tiles), TILE_INCHES[1]), layout="constrained")
        row = figure.subplots(1, len(tiles))
        for axes, (title, picture) in zip(row, tiles.items(), strict=True):
            axes.set_axis_off()
            axes.imshow(picture)
            axes.set_title(title, fontsize=10)
        scale = ScalarMappable(Normalize(0, 100 * WORST * threshold_m), COLOUR_MAP)
        bar = figure.colorbar(scale, ax=row, shrink=0.7, extend="max", label="distance (cm)")
        bar.ax.axhline(100 * threshold_m, color="white", linewidth=2)
        figure.savefig(file, dpi=DPI, format="png", metadata={"Software": None})


def _split(vertices: Vertices, faces: Faces) -> tuple[Vertices, Faces]:
    """Triangles halved until no edge is longer than `EDGE_M`."""
    from trimesh.remesh import subdivide_to_size

    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    if (
        area / EDGE_M**2 > MOST_TRIANGLES / 4
    ):  # a split leaves triangles of about a quarter to half of that edge's square
        return vertices, faces
    fine, split = subdivide_to_size(vertices, faces, EDGE_M, max_iter=20)  # type: ignore[no-untyped-call]  # trimesh's
    return np.asarray(fine, np.float32), np.asarray(split, np.int32)
