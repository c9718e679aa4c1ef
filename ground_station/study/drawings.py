"""A study's figures: curves with bands over the seeds, phase portraits, gains over time; SVG and PNG of each."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeAlias

import numpy as np

from ground_station.palette import DRONE_COLOURS
from ground_station.report.figures import FAINT, INK, JUMP, SCORE_COLOURS, STYLE
from ground_station.report.picture import Picture
from ground_station.study import paper
from ground_station.study.flown import Flown, by_series
from ground_station.study.plan_file import Series
from ground_station.study.statistics import paired_difference
from ground_station.study.tables import SURFACES
from protocol.geometry import Floats

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STEP_S = 1.0
"""Between two instants of a curve over seeds; as metrics.csv has them."""
GAIN_STEP_S = 10.0
"""Between two instants of a gain: as live scores come."""
PANEL_INCHES = (4.6, 3.4)
TILE_INCHES = (4.6, 3.7)
"""Of a picture with a title of two lines."""
PNG_DPI = 130
BAND_ALPHA = 0.18
RATE_WINDOW_S = 9
"""Over which the rate of J is taken in a phase portrait: several looks at the map, so that jumps are seen as a flow."""

Bands: TypeAlias = tuple[Floats, Floats, Floats, Floats]
"""Time (T,), mean, lowest and highest over the flights (T,)."""


@dataclass(frozen=True, slots=True)
class Panel:
    title: str
    chosen: Callable[[Series], bool]
    name: Callable[[Series], str]


PANELS: Final = (
    Panel(
        "feedback, one drone",
        lambda series: series[1] in ("none", "grid", "m3c2") and series[2:] == (1, paper.THRESHOLD),
        lambda series: {"none": "no feedback", "grid": "grid", "m3c2": "M3C2"}[series[1]],
    ),
    Panel(
        "planners, one drone",
        lambda series: series[1] != "m3c2" and series[2:] == (1, paper.THRESHOLD),
        lambda series: series[1].replace("_", " "),
    ),
    Panel(
        "teams, grid feedback",
        lambda series: series[1] == "grid" and series[3] == paper.THRESHOLD,
        lambda series: f"{series[2]} drone{'s' * (series[2] > 1)}",
    ),
)
"""The paper's: J and F of kinds of feedback, of planners, of teams."""


def curves_over_seeds(flights: Sequence[Flown], column: str) -> Bands:
    """Of flights of one series, from the first instant to the last that all of them have."""
    last = min(float(flown.curves["time_s"][-1]) for flown in flights)
    time_s = np.arange(0.0, last + STEP_S / 2, STEP_S)
    values = []
    for flown in flights:
        at, curve = flown.points(column)
        values.append(np.interp(time_s, at, curve, left=np.nan) if len(at) else np.full_like(time_s, np.nan))
    stacked = np.array(values)
    return time_s, stacked.mean(axis=0), stacked.min(axis=0), stacked.max(axis=0)


def draw_curves(flights: Sequence[Flown], column: str, ylabel: str, stem: Path) -> list[Path]:
    """A row of `PANELS`, none without a series: of each series the mean, and a band from its lowest to its highest."""
    series = by_series(flights)
    panels = [(panel, shown) for panel in PANELS if (shown := [each for each in series if panel.chosen(each)])]

    def draw(figure: Figure) -> None:
        row = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        for axes, (panel, shown) in zip(row, panels, strict=True):
            for index, each in enumerate(shown):
                time_s, mean, low, high = curves_over_seeds(series[each], column)
                colour = DRONE_COLOURS[index % len(DRONE_COLOURS)]
                axes.plot(time_s, mean, color=colour, label=panel.name(each))
                axes.fill_between(time_s, low, high, color=colour, alpha=BAND_ALPHA, linewidth=0)
            axes.set(title=panel.title, xlabel="mission time (s)", ylim=(0, 1.02))
            axes.legend(fontsize=8)
        row[0].set_ylabel(ylabel)

    return saved(draw, stem, columns=len(panels)) if panels else []


def draw_portraits(flights: Sequence[Flown], stem: Path) -> list[Path]:
    """Phase portraits of one drone with grid feedback, a column for each J_th: the rate of J over J, and F over J.

    A flight runs from right to left. Below J_th jumps push it back to the right; where the rate crosses zero, feedback
    and flight are in balance.
    """
    series = by_series(flights)
    shown = sorted((each for each in series if each[1:3] == ("grid", 1)), key=lambda each: each[3])

    def draw(figure: Figure) -> None:
        rows = figure.subplots(2, len(shown), sharex=True, sharey="row", squeeze=False)
        for column, each in enumerate(shown):
            above, below = rows[:, column]
            for index, flown in enumerate(series[each]):
                colour = DRONE_COLOURS[index % len(DRONE_COLOURS)]
                importance = flown.curves["importance"]
                rate = rate_of(flown.curves["time_s"], importance)
                above.plot(importance, 1e3 * rate, color=colour, linewidth=0.9, label=f"seed {flown.planned.seed}")
                scored_s, scores = flown.points("f_score_visible")
                at_score = np.interp(scored_s, flown.curves["time_s"], importance)
                below.plot(at_score, scores, color=colour, linewidth=1.1)
            above.axhline(0, color=FAINT, linewidth=0.8)
            for axes in (above, below):
                axes.axvline(each[3], color=JUMP, linewidth=1, linestyle=(0, (4, 3)))
            above.set(title=f"J_th = {100 * each[3]:.0f} %", xlim=(1.02, 0))
            below.set(xlabel="importance J", ylim=(0, 1.02))
        rows[0, 0].set_ylabel("rate of J (1/1000 s)")
        rows[1, 0].set_ylabel("F visible")
        rows[0, 0].legend(fontsize=8)

    return saved(draw, stem, columns=len(shown), rows=2) if shown else []


def rate_of(time_s: Floats, importance: Floats) -> Floats:
    """Of J, 1/s, the mean slope over `RATE_WINDOW_S`; NaN where the window reaches beyond the flight."""
    half = round(RATE_WINDOW_S / 2)
    rate = np.full(len(time_s), np.nan)
    if len(time_s) > 2 * half:
        span = time_s[2 * half :] - time_s[: -2 * half]
        rate[half:-half] = (importance[2 * half :] - importance[: -2 * half]) / span
    return rate


def draw_gains(flights: Sequence[Flown], duration_s: float, stem: Path) -> list[Path]:
    """F with grid feedback minus F without, over time: each pair thin, their mean, and its confidence interval."""
    flown = {(f.planned.scene, f.planned.seed, f.planned.method): f for f in flights}
    scenes: dict[str, list[tuple[Flown, Flown]]] = {}
    for (scene, seed, method), without in flown.items():
        if method == "none" and (scene, seed, "grid") in flown:
            scenes.setdefault(scene, []).append((without, flown[scene, seed, "grid"]))
    instants = np.arange(GAIN_STEP_S, duration_s + GAIN_STEP_S / 2, GAIN_STEP_S)

    def draw(figure: Figure) -> None:
        rows = figure.subplots(len(SURFACES), len(scenes), sharex=True, sharey="row", squeeze=False)
        for column, (scene, pairs) in enumerate(scenes.items()):
            for row, (surface, name) in enumerate(SURFACES.items()):
                axes, colour = rows[row, column], SCORE_COLOURS[surface]
                values = np.array([[[f.at(name, time_s) for f in pair] for pair in pairs] for time_s in instants])
                axes.plot(instants, values[:, :, 1] - values[:, :, 0], color=FAINT, linewidth=0.7)
                gains = [paired_difference(each[:, 0].tolist(), each[:, 1].tolist()) for each in values]
                mean = np.array([gain.mean for gain in gains])
                half = np.array([gain.half_width for gain in gains])
                axes.plot(instants, mean, color=colour)
                axes.fill_between(instants, mean - half, mean + half, color=colour, alpha=BAND_ALPHA, linewidth=0)
                axes.axhline(0, color=INK, linewidth=0.8)
                axes.set_ylabel(f"gain in F, {surface}" if column == 0 else "")
            rows[0, column].set_title(scene)
            rows[-1, column].set_xlabel("mission time (s)")

    return saved(draw, stem, columns=len(scenes), rows=len(SURFACES)) if scenes else []


def pictures(tiles: Mapping[str, Picture], stem: Path, most_columns: int) -> list[Path]:
    """Pictures (height, width, 3) uint8 side by side under their titles; as PNG alone."""
    columns = min(most_columns, len(tiles))
    rows = math.ceil(len(tiles) / columns)

    def draw(figure: Figure) -> None:
        places = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes in places:
            axes.set_axis_off()
        for axes, (title, picture) in zip(places, tiles.items(), strict=False):
            axes.imshow(picture)
            axes.set_title(title, fontsize=9)

    return saved(draw, stem, columns=columns, rows=rows, inches=TILE_INCHES, vector=False)


def saved(
    draw: Callable[[Figure], None],
    stem: Path,
    *,
    columns: int,
    rows: int = 1,
    inches: tuple[float, float] = PANEL_INCHES,
    vector: bool = True,
) -> list[Path]:
    """The same flights give the same bytes."""
    from matplotlib import style
    from matplotlib.figure import Figure

    width, height = inches
    paths = []
    with style.context(STYLE):
        figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
        draw(figure)
        if vector:
            paths.append(stem.with_suffix(".svg"))
            figure.savefig(paths[-1], metadata={"Date": None})
        paths.append(stem.with_suffix(".png"))
        figure.savefig(paths[-1], dpi=PNG_DPI, metadata={"Software": None})
    return paths


def shown(caption: str, files: Sequence[Path]) -> Iterator[str]:
    """A figure in Markdown with its caption: by the first of its files, a drawing's SVG; nothing without files."""
    if files:
        yield f"![{caption}]({files[0].name})"
        yield ""
        yield f"*{caption}.*"
        yield ""
