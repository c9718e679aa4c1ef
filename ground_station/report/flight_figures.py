"""The report's drawings of what each drone flew and how its controller fared."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from ground_station.palette import drone_colour
from ground_station.report.figures import FAINT, LIMIT, span, svg, svg_of_stack
from ground_station.report.run_data import Flight
from ground_station.report.spells import spells
from protocol.geometry import Floats
from protocol.messages import UNLIMITED
from protocol.mission import Mission

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PLAN_INCHES = (6.0, 6.1)
MARGINS_INCHES = (6.0, 6.2)
"""Of all kinds of rows together; they share the height."""
MODES_INCHES = (12.5, 0.8)
"""Without drones."""
BAR_INCHES = 0.19
DASHED = (0, (4, 3))
HISTOGRAM_BINS = 60
COLUMNS, COARSE_COLUMNS = 500, 150
"""Stretches that a flight is drawn in, however long it was: about one a pixel, and fewer for what scatters."""
NEAR = 4.0
"""Separation barriers are drawn up to so many d², where two drones are more than twice d apart."""
ZONE_SHADE = 0.35
"""Opacity of a zone from floor to ceiling."""
MODE_COLOURS = {
    "flying": "#cfe3f1",
    "braking": "#c62828",
    "joining": "#e69f00",
    "holding": "#6f4e9c",
    "returning": "#cc79a7",
    "landing": "#009e73",
    "landed": "#b7d8cc",
    "yielded": "#1f2933",
    "starting": "#e4e7eb",
}
"""What a crew wants to find is dark, what is as it should be is pale."""


def margins(flight: Flight, mission: Mission) -> str:
    """The barriers b of each drone's strict rows over time, the smallest of each stretch; below 0 one was broken."""
    rows = [
        ("separation (m²)", flight.separation_margin_m2),
        ("region (m)", flight.region_margin_m),
        ("pitch (rad²)", flight.pitch_margin_rad2),
    ]
    if (flight.obstacle_margin_m < UNLIMITED).any():
        rows.insert(2, ("obstacles (m)", flight.obstacle_margin_m))

    def of(place: int, label: str, margin: Floats) -> Any:
        def draw(axes: Axes) -> None:
            for index, time_s, smallest in _stretches(flight, np.where(margin < UNLIMITED, margin, np.nan), np.fmin):
                axes.plot(
                    time_s, smallest, color=drone_colour(index), linewidth=1, label=_name(flight, index, place == 0)
                )
            broken = "a barrier is broken below 0" if place == 0 else "_"
            axes.axhline(0, color=LIMIT, linewidth=1, linestyle=DASHED, label=broken)
            axes.set(ylabel=label, xlim=span(flight.time_s))
            low, high = axes.get_ylim()
            if place == 0:  # what is farther away is nobody's concern, and would flatten what is near
                high = min(high, NEAR * mission.flight.separation_m**2)
            axes.set_ylim(min(low, -0.05 * high), high)
            if place == len(rows) - 1:
                axes.set_xlabel("mission time (s)")

        return draw

    return svg_of_stack([of(place, *row) for place, row in enumerate(rows)], MARGINS_INCHES)


def heights(flight: Flight, mission: Mission) -> str:
    """z of each drone over time, and the floor and ceiling of the flight region P."""

    def draw(axes: Axes) -> None:
        for index, time_s, height in _stretches(flight, flight.poses[:, :, 2], np.fmax):
            axes.plot(time_s, height, color=drone_colour(index), linewidth=1.2, label=_name(flight, index))
        low, high = mission.flight.lower_m[2], mission.flight.upper_m[2]
        axes.axhline(low, color=FAINT, linewidth=1, linestyle=DASHED, label="flight region P")
        axes.axhline(high, color=FAINT, linewidth=1, linestyle=DASHED)
        axes.set(xlabel="mission time (s)", ylabel="height z (m)", xlim=span(flight.time_s))
        axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))

    return svg(draw)


def modes(flight: Flight) -> str:
    """What each drone was doing, one bar a drone."""

    def draw(axes: Axes) -> None:
        shown = [mode for mode in MODE_COLOURS if (flight.mode == mode).any()]
        for index in range(len(flight.drones)):
            for mode in shown:
                held = spells(flight.time_s, flight.mode[:, index] == mode)
                bars = [(spell.start_s, spell.end_s - spell.start_s) for spell in held]
                axes.broken_barh(bars, (index - 0.36, 0.72), facecolor=MODE_COLOURS[mode], linewidth=0)
        for mode in shown:
            axes.bar(0, 0, color=MODE_COLOURS[mode], label=mode)
        axes.set(xlabel="mission time (s)", xlim=span(flight.time_s), ylim=(len(flight.drones) - 0.5, -0.5))
        axes.set_yticks(range(len(flight.drones)), [f"drone {drone}" for drone in flight.drones])
        axes.grid(visible=False)

    width, height = MODES_INCHES
    return svg(draw, (width, height + BAR_INCHES * len(flight.drones)))


def solve_times_over_time(flight: Flight, tick_s: float) -> str:
    """The longest solve of each stretch, per drone, and the tick that it must fit in."""

    def draw(axes: Axes) -> None:
        for index, time_s, longest in _stretches(flight, 1e3 * flight.solve_time_s, np.fmax, COARSE_COLUMNS):
            axes.plot(time_s, longest, color=drone_colour(index), linewidth=0.9, label=_name(flight, index))
        axes.axhline(1e3 * tick_s, color=LIMIT, linewidth=1, linestyle=DASHED, label=f"tick {1e3 * tick_s:g} ms")
        axes.set(xlabel="mission time (s)", ylabel="longest solve (ms)", yscale="log", xlim=span(flight.time_s))
        axes.yaxis.set_major_formatter("{x:g}")

    return svg(draw)


def _stretches(
    flight: Flight, values: Floats, reduce: np.ufunc, columns: int = COLUMNS
) -> Iterator[tuple[int, Floats, Floats]]:
    """Each drone that has any of ``values`` (T, D): its index, and time and reduced value of each stretch."""
    first = np.unique(np.linspace(0, len(flight.time_s), columns, endpoint=False).astype(np.int64))
    reduced = reduce.reduceat(values, first, axis=0)
    for index in range(len(flight.drones)):
        if np.isfinite(reduced[:, index]).any():
            yield index, flight.time_s[first], reduced[:, index]


def _name(flight: Flight, index: int, wanted: bool = True) -> str:
    return f"drone {flight.drones[index]}" if wanted else "_"


def paths(flight: Flight, mission: Mission) -> str:
    """As `draw_paths` draws them."""
    return svg(lambda axes: draw_paths(axes, flight, mission), PLAN_INCHES)


def draw_paths(axes: Axes, flight: Flight, mission: Mission) -> None:
    """Paths from above over the target B (filled) and the flight region P (dashed), with its boundary and no-fly zones
    (red; one that leaves a way above or below is paler). A dot starts, an arrow ends."""
    from matplotlib.patches import Rectangle

    for box, style in (
        (mission.flight, {"fill": False, "edgecolor": FAINT, "linestyle": (0, (4, 3)), "label": "flight region P"}),
        (mission.target, {"facecolor": "#eef2f6", "edgecolor": FAINT, "label": "target B"}),
    ):
        (x0, y0, _), (x1, y1, _) = box.lower_m, box.upper_m
        axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, linewidth=0.8, **style))
    _draw_zones(axes, mission)
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


def _draw_zones(axes: Axes, mission: Mission) -> None:
    from matplotlib.patches import Polygon

    region = mission.flight
    if region.boundary is not None:
        axes.add_patch(Polygon(region.boundary, fill=False, edgecolor=LIMIT, linewidth=1, label="boundary"))
    label = "no-fly zone"
    for zone in region.no_fly:
        through = (zone.lower_m is None or zone.lower_m <= region.lower_m[2]) and (
            zone.upper_m is None or zone.upper_m >= region.upper_m[2]
        )
        shade = ZONE_SHADE if through else ZONE_SHADE / 2
        axes.add_patch(Polygon(zone.polygon, facecolor=LIMIT, alpha=shade, linewidth=0, label=label))
        axes.add_patch(Polygon(zone.polygon, fill=False, edgecolor=LIMIT, linewidth=0.8))
        label = "_"


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
        axes.axvline(1e3 * tick_s, color=LIMIT, linewidth=1, linestyle=DASHED, label=f"tick {1e3 * tick_s:g} ms")
        axes.set(xlabel="solve time (ms)", ylabel="share of ticks (%)", xscale="log", xlim=(bins[0], bins[-1]))
        axes.xaxis.set_major_formatter("{x:g}")

    return svg(draw)
