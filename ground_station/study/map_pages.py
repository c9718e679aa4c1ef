"""Tables, figures and page of the random-room suite."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Final

from ground_station.durable import replace_file
from ground_station.mesh_files import read_ply
from ground_station.palette import DRONE_COLOURS
from ground_station.report.figures import FAINT
from ground_station.report.picture import Picture, oblique_view
from ground_station.report.run_data import Mesh
from ground_station.results import MESH_PLY_FILE
from ground_station.study.drawings import pictures, saved, shown
from ground_station.study.mapped import FLOOR, MEASURES, LevelRow, Mapped, level_rows
from ground_station.study.meshes import TILE_PX, corners_of, truth_of
from ground_station.study.plan_file import FLIGHTS_FOLDER
from ground_station.study.tables import cell, csv_text, markdown, spread_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SHOWN_ROOMS: Final = 3
"""In the picture of meshes."""
FIGURES: Final = {"f_visible": "F visible", "f_objects": "F objects"}
"""What the figure shows over the texture's contrast."""


def write_maps(folder: Path, maps: Sequence[Mapped]) -> Iterator[str]:
    """Write all but the page itself, whose lines come out. Raises OSError, and CovreconError for a damaged mesh."""
    rows = level_rows(maps)
    replace_file(folder / "maps.csv", [maps_csv(maps).encode()])
    replace_file(folder / "levels.csv", [levels_csv(rows).encode()])
    replace_file(folder / "maps.json", [(maps_json(maps) + "\n").encode()])
    yield levels_markdown(rows)
    yield ""
    yield "Mean ± standard deviation over the rooms; (n of m) where only so many could be mapped. F at 5 cm; precision"
    yield "and recall are of the visible surface, milliseconds of one core's processor time."
    yield ""
    yield from _skipped(rows)
    drawn = draw_levels(rows, folder / "levels")
    yield from shown("F by texture contrast, mean over the rooms; dashed a bare floor", drawn)
    yield from shown("Maps of the first rooms, F of visible surface and of objects", draw_rooms(maps, folder / "rooms"))


def levels_markdown(rows: Sequence[LevelRow]) -> str:
    lines = [["texture", "map", *(measure.title for measure in MEASURES)]]
    for row in rows:
        cells = [spread_text(row.spreads[measure.key], measure.decimals) for measure in MEASURES]
        lines.append([f"{100 * row.contrast:g} %", _name(row.way), *cells])
    return markdown(lines)


def levels_csv(rows: Sequence[LevelRow]) -> str:
    header = ["contrast", "way", "rooms", "reasons"]
    for measure in MEASURES:
        header += [measure.key, f"{measure.key}_deviation", f"{measure.key}_known"]
    lines: list[list[object]] = []
    for row in rows:
        line: list[object] = [row.contrast, row.way, row.spreads[MEASURES[0].key].count, "; ".join(row.reasons)]
        for measure in MEASURES:
            spread = row.spreads[measure.key]
            line += [cell(spread.mean), cell(spread.deviation), spread.known]
        lines.append(line)
    return csv_text([header, *lines])


def maps_csv(maps: Sequence[Mapped]) -> str:
    keys = [measure.key for measure in MEASURES]
    header = ["room", "contrast", "way", *keys, *(f"floor_{key}" for key in keys[:3]), "reason"]
    lines: list[list[object]] = []
    for each in maps:
        figures: list[object] = [cell(each.figures[key]) for key in keys]
        floor: list[object] = [cell(each.floor[key]) for key in keys[:3]]
        flight = each.planned.flight
        lines.append([flight.scene, flight.contrast, each.planned.way, *figures, *floor, each.reason])
    return csv_text([header, *lines])


def maps_json(maps: Sequence[Mapped]) -> str:
    """All maps and their means; ``null`` for what there is not."""
    told = {
        "maps": [
            {
                "room": each.planned.flight.scene,
                "contrast": each.planned.flight.contrast,
                "way": each.planned.way,
                **_known(each.figures),
                "floor": _known(each.floor),
                "reason": each.reason,
            }
            for each in maps
        ],
        "levels": [
            {
                "contrast": row.contrast,
                "way": row.way,
                "reasons": row.reasons,
                **{key: _known(asdict(spread)) for key, spread in row.spreads.items()},
            }
            for row in level_rows(maps)
        ],
    }
    return json.dumps(told, indent=2, allow_nan=False)


def draw_levels(rows: Sequence[LevelRow], stem: Path) -> list[Path]:
    """A panel for each of `FIGURES`: a group of bars for each contrast, one for each way."""
    contrasts = list(dict.fromkeys(row.contrast for row in rows))
    ways = list(dict.fromkeys(row.way for row in rows if row.way != FLOOR))
    if not any(math.isfinite(row.spreads["f_visible"].mean) for row in rows):
        return []

    def draw(figure: Figure) -> None:
        for axes, (key, title) in zip(figure.subplots(1, len(FIGURES), sharey=True), FIGURES.items(), strict=True):
            known = {(row.contrast, row.way): row.spreads[key] for row in rows}
            width = 0.8 / len(ways)
            for number, way in enumerate(ways):
                spreads = [known.get((contrast, way)) for contrast in contrasts]
                at = [place - 0.4 + (number + 0.5) * width for place in range(len(contrasts))]
                means = [spread.mean if spread else math.nan for spread in spreads]
                error = [spread.deviation if spread and spread.known > 1 else 0.0 for spread in spreads]
                colour = DRONE_COLOURS[number % len(DRONE_COLOURS)]
                axes.bar(at, means, 0.92 * width, yerr=error, color=colour, label=way.replace("_", " "), ecolor=FAINT)
            for place, contrast in enumerate(contrasts):
                floor = known.get((contrast, FLOOR))
                if floor is not None:
                    axes.hlines(floor.mean, place - 0.45, place + 0.45, color=FAINT, linestyle="dashed")
            axes.set_xticks(range(len(contrasts)), [f"{100 * contrast:g} %" for contrast in contrasts])
            axes.set(title=title, xlabel="texture contrast", ylim=(0, 1))
        figure.axes[0].legend(fontsize=8, loc="lower left")

    return saved(draw, stem, columns=len(FIGURES))


def draw_rooms(maps: Sequence[Mapped], stem: Path) -> list[Path]:
    """Of the first rooms under their strongest texture: the scene, then each way's map; ways without any left out."""
    contrast = max((each.planned.flight.contrast for each in maps), default=1.0)
    strongest = [each for each in maps if each.planned.flight.contrast == contrast and not each.reason]
    scenes = list(dict.fromkeys(each.planned.flight.scene for each in strongest))[:SHOWN_ROOMS]
    ways = list(dict.fromkeys(each.planned.way for each in strongest))
    tiles: dict[str, Picture] = {}
    for scene in scenes:
        own = {each.planned.way: each for each in strongest if each.planned.flight.scene == scene}
        flight = stem.parent / FLIGHTS_FOLDER / next(iter(own.values())).planned.flight.folder
        frame, truth = corners_of(flight), truth_of(flight)
        if truth is not None:
            tiles[scene] = oblique_view(truth, *TILE_PX, framed=frame)
        for way in ways:
            if way in own:
                scores = ", ".join(f"{own[way].figures[key]:.3f}" for key in FIGURES)
                tiles[f"{scene}, {way}\nF {scores}"] = oblique_view(_mesh(own[way]), *TILE_PX, framed=frame)
    return pictures(tiles, stem, 1 + len(ways)) if tiles else []


def _mesh(mapped: Mapped) -> Mesh:
    path = mapped.folder / MESH_PLY_FILE
    found = read_ply(path.read_bytes(), str(path))
    return Mesh(found.vertices, found.faces, found.colors)


def _skipped(rows: Sequence[LevelRow]) -> Iterator[str]:
    reasons = {(row.way, reason) for row in rows for reason in row.reasons}
    for way, reason in sorted(reasons):
        yield f"* {_name(way)} made no map of some rooms: {reason}"
    if reasons:
        yield ""


def _name(way: str) -> str:
    return way if way == FLOOR else f"`{way}`"


def _known(figures: Mapping[str, float]) -> dict[str, float | None]:
    return {key: value if math.isfinite(value) else None for key, value in figures.items()}
