"""The report's curves of the mission as a whole, as SVG text that is the same for the same run."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ground_station.palette import drone_colour
from ground_station.report.run_data import Curves
from protocol.geometry import Floats
from protocol.mission import Mission

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIZE_INCHES = (6.0, 3.1)
INK, FAINT, LIMIT, JUMP = "#1f2933", "#9aa5b1", "#c62828", "#b26a00"
SCORE_COLOURS = {"visible": "#0072b2", "exposed": "#009e73", "objects": "#d55e00"}
LEGEND_COLUMNS = 5
JUMP_MARK_FRAC = 0.045
"""Height of the mark of a jump, of the axis."""
STYLE: dict[str, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "coverage-recon",
    "font.family": "DejaVu Sans",  # ships with matplotlib, so the layout is the same everywhere; the page sets its own
    "font.size": 9,
    "text.color": INK,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": "#52606d",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.prop_cycle": "cycler('color', ['#0072b2'])",
    "grid.color": "#e4e7eb",
    "grid.linewidth": 0.7,
    "xtick.color": "#7b8794",
    "ytick.color": "#7b8794",
    "legend.frameon": False,
    "lines.linewidth": 1.6,
    "lines.solid_capstyle": "round",
}


def importance(curves: Curves, mission: Mission) -> str:
    """J over mission time, the threshold below which feedback jumps, and a mark at each row with new jumps."""

    def draw(axes: Axes) -> None:
        time_s, jumps = curves["time_s"], curves["jumps"]
        axes.plot(time_s, curves["importance"], color=INK, label="J")
        if mission.feedback.method != "none":
            axes.axhline(mission.feedback.threshold, color=JUMP, linewidth=1, linestyle=(0, (4, 3)), label="J_th")
        jumped = time_s[np.diff(jumps, prepend=0.0) > 0]
        if len(jumped):
            axes.vlines(
                jumped,
                0,
                JUMP_MARK_FRAC,
                transform=axes.get_xaxis_transform(),
                color=JUMP,
                linewidth=1,
                label=f"jumps ({int(jumps[-1])})",
            )
        axes.set(xlabel="mission time (s)", ylabel="importance J", ylim=(0, 1.02), xlim=span(time_s))

    return svg(draw)


def f_scores(curves: Curves, baseline: Mapping[str, float]) -> str:
    """F over mission time, and the floor's as a dotted line of the same colour."""

    def draw(axes: Axes) -> None:
        for name, colour in SCORE_COLOURS.items():
            values = curves[f"f_score_{name}"]
            # Rows repeat the newest score until the next one; a line through the new ones is no staircase.
            fresh = np.isfinite(values) & (np.diff(values, prepend=np.nan) != 0)
            axes.plot(curves["time_s"][fresh], values[fresh], color=colour, label=name, marker="o", markersize=2.4)
            if name in baseline:
                axes.axhline(baseline[name], color=colour, linewidth=1, linestyle=(0, (1, 2)))
        if baseline:
            axes.plot([], [], color=FAINT, linewidth=1, linestyle=(0, (1, 2)), label="bare floor")
        axes.set(xlabel="mission time (s)", ylabel="F-score at 5 cm", ylim=(0, 1.02), xlim=span(curves["time_s"]))

    return svg(draw)


def separation(curves: Curves, drones: Sequence[int], limit_m: float) -> str:
    """Distance of each drone to its nearest neighbour, the smallest between two rows, and the limit d."""

    def draw(axes: Axes) -> None:
        for index, drone in enumerate(drones):
            distance = curves[f"separation_{drone}_m"]
            axes.plot(curves["time_s"], distance, color=drone_colour(index), linewidth=1.2, label=f"drone {drone}")
        axes.axhline(limit_m, color=LIMIT, linewidth=1, linestyle=(0, (4, 3)), label=f"d = {limit_m:g} m")
        axes.axhspan(0, limit_m, color=LIMIT, alpha=0.05, linewidth=0)
        axes.set(xlabel="mission time (s)", ylabel="nearest neighbour (m)", xlim=span(curves["time_s"]))
        axes.set_ylim(bottom=0)

    return svg(draw)


def span(time_s: Floats) -> tuple[float, float]:
    return 0.0, max(float(time_s[-1]), 1.0)


def svg(draw: Callable[[Axes], None], size: tuple[float, float] = SIZE_INCHES) -> str:
    """One drawing; see `svg_of_stack`."""
    return svg_of_stack([draw], size)


def svg_of_stack(drawings: Sequence[Callable[[Axes], None]], size: tuple[float, float]) -> str:
    """Drawings over one another, with the horizontal axis in common, as an ``svg`` element that takes the width of
    its place; ``size`` in inches. Whatever any of them labels comes into one legend."""
    from matplotlib import style
    from matplotlib.figure import Figure

    content = io.StringIO()
    with style.context(STYLE):
        figure = Figure(figsize=size, layout="constrained")
        stack = figure.subplots(len(drawings), 1, sharex=True, squeeze=False)[:, 0]
        for draw, axes in zip(drawings, stack, strict=True):
            draw(axes)
        # Above the axes, where it hides no curve, in as many rows as the team needs.
        figure.legend(loc="outside upper left", ncols=LEGEND_COLUMNS, fontsize=8, handlelength=1.4, borderpad=0)
        figure.savefig(content, format="svg", metadata={"Date": None}, transparent=True)
    text = content.getvalue()
    text = re.sub(r"<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.DOTALL)
    text = re.sub(r'<g id="[^"]*">', "<g>", text)  # the same names would come in every figure of the page
    head, body = text.split(">", 1)
    return re.sub(r' (?:width|height)="[^"]*"', "", head) + ">" + body
