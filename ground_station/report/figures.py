"""The report's curves, as SVG text that is the same for the same run."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ground_station.report.run_data import Curves, Flight
from protocol.geometry import Floats
from protocol.mission import Mission

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIZE_INCHES = (6.0, 3.1)
PLAN_INCHES = (6.0, 6.1)
INK, FAINT, LIMIT, JUMP = "#1f2933", "#9aa5b1", "#c62828", "#b26a00"
DRONE_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#6f4e9c", "#7a7a7a")
"""Okabe and Ito's set without yellow and black, two more added: told apart by colour-blind readers and in print."""
SCORE_COLOURS = {"visible": "#0072b2", "exposed": "#009e73", "objects": "#d55e00"}
LEGEND_COLUMNS = 5
JUMP_MARK_FRAC = 0.045
"""Height of the mark of a jump, of the axis."""
HISTOGRAM_BINS = 60
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


def drone_colour(index: int) -> str:
    return DRONE_COLOURS[index % len(DRONE_COLOURS)]


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
        axes.set(xlabel="mission time (s)", ylabel="importance J", ylim=(0, 1.02), xlim=_span(time_s))

    return _svg(draw)


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
        axes.set(xlabel="mission time (s)", ylabel="F-score at 5 cm", ylim=(0, 1.02), xlim=_span(curves["time_s"]))

    return _svg(draw)


def separation(curves: Curves, drones: Sequence[int], limit_m: float) -> str:
    """Distance of each drone to its nearest neighbour, the smallest between two rows, and the limit d."""

    def draw(axes: Axes) -> None:
        for index, drone in enumerate(drones):
            distance = curves[f"separation_{drone}_m"]
            axes.plot(curves["time_s"], distance, color=drone_colour(index), linewidth=1.2, label=f"drone {drone}")
        axes.axhline(limit_m, color=LIMIT, linewidth=1, linestyle=(0, (4, 3)), label=f"d = {limit_m:g} m")
        axes.axhspan(0, limit_m, color=LIMIT, alpha=0.05, linewidth=0)
        axes.set(xlabel="mission time (s)", ylabel="nearest neighbour (m)", xlim=_span(curves["time_s"]))
        axes.set_ylim(bottom=0)

    return _svg(draw)


def paths(flight: Flight, mission: Mission) -> str:
    """Paths from above over the target B (filled) and the flight region P (dashed); a dot starts, an arrow ends."""

    def draw(axes: Axes) -> None:
        from matplotlib.patches import Rectangle

        for box, style in (
            (mission.flight, {"fill": False, "edgecolor": FAINT, "linestyle": (0, (4, 3)), "label": "flight region P"}),
            (mission.target, {"facecolor": "#eef2f6", "edgecolor": FAINT, "label": "target B"}),
        ):
            (x0, y0, _), (x1, y1, _) = box.lower_m, box.upper_m
            axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, linewidth=0.8, **style))
        for index, drone in enumerate(flight.drones):
            path = flight.poses[:, index]
            path = path[np.isfinite(path[:, 0])]
            if not len(path):
                continue
            colour = drone_colour(index)
            axes.plot(path[:, 0], path[:, 1], color=colour, linewidth=0.9, alpha=0.85, label=f"drone {drone}")
            axes.plot(*path[0, :2], "o", color=colour, markersize=5, markeredgecolor="white")
            yaw_deg = float(np.degrees(path[-1, 3]))
            axes.plot(*path[-1, :2], marker=(3, 0, yaw_deg - 90), color=colour, markersize=9, markeredgecolor="white")
        axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", anchor="N")
        axes.autoscale_view()
        axes.grid(visible=False)

    return _svg(draw, PLAN_INCHES)


def solve_times(flight: Flight, tick_s: float) -> str:
    """Distribution of the quadratic program's solve time, per drone, and the tick that it must fit in."""

    def draw(axes: Axes) -> None:
        milliseconds = 1e3 * flight.solve_time_s
        known = milliseconds[np.isfinite(milliseconds) & (milliseconds > 0)]
        low, high = min(float(known.min()), 1e3 * tick_s), max(float(known.max()), 1e3 * tick_s)
        bins = np.geomspace(low / 1.2, high * 1.2, HISTOGRAM_BINS + 1).tolist()
        for index, drone in enumerate(flight.drones):
            own = milliseconds[:, index]
            own = own[np.isfinite(own)]
            if len(own):
                share = np.full(len(own), 100 / len(own))
                colour = drone_colour(index)
                axes.hist(
                    own, bins, weights=share, histtype="step", color=colour, linewidth=1.4, label=f"drone {drone}"
                )
        axes.axvline(1e3 * tick_s, color=LIMIT, linewidth=1, linestyle=(0, (4, 3)), label=f"tick {1e3 * tick_s:g} ms")
        axes.set(xlabel="solve time (ms)", ylabel="share of ticks (%)", xscale="log", xlim=(bins[0], bins[-1]))
        axes.xaxis.set_major_formatter("{x:g}")

    return _svg(draw)


def _span(time_s: Floats) -> tuple[float, float]:
    return 0.0, max(float(time_s[-1]), 1.0)


def _svg(draw: Callable[[Axes], None], size: tuple[float, float] = SIZE_INCHES) -> str:
    """The drawing as an ``svg`` element that takes the width of its place."""
    from matplotlib import style
    from matplotlib.figure import Figure

    content = io.StringIO()
    with style.context(STYLE):
        figure = Figure(figsize=size, layout="constrained")
        draw(figure.add_subplot())
        # Above the axes, where it hides no curve, in as many rows as the team needs.
        figure.legend(loc="outside upper left", ncols=LEGEND_COLUMNS, fontsize=8, handlelength=1.4, borderpad=0)
        figure.savefig(content, format="svg", metadata={"Date": None}, transparent=True)
    text = content.getvalue()
    text = re.sub(r"<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.DOTALL)
    text = re.sub(r'<g id="[^"]*">', "<g>", text)  # the same names would come in every figure of the page
    head, body = text.split(">", 1)
    return re.sub(r' (?:width|height)="[^"]*"', "", head) + ">" + body
