"""The plan's picture: J over time with the swaps, what is left of each battery, and the paths from above."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from deploy.plan_estimate import Plan
from ground_station.palette import drone_colour
from ground_station.report.flight_figures import draw_paths
from ground_station.report.run_data import Flight, Run
from protocol.errors import StorageError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIZE_INCHES, DPI = (12.0, 6.4), 120


def draw_plan(plan: Plan, run: Run, flight: Flight, path: Path) -> None:
    """Write a PNG. Raises `StorageError` where that cannot be."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=SIZE_INCHES, layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(1.35, 1))
    importance = figure.add_subplot(grid[0, 0])
    battery = figure.add_subplot(grid[1, 0], sharex=importance)
    above = figure.add_subplot(grid[:, 1])
    _draw_importance(importance, plan, run)
    _draw_batteries(battery, plan, run, flight)
    draw_paths(above, flight, run.mission)
    above.legend(loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=4, fontsize=8, frameon=False)
    figure.suptitle(_title(plan))
    try:
        figure.savefig(path, dpi=DPI)
    except OSError as error:
        raise StorageError(f"{path}: {error.strerror}") from error


def _title(plan: Plan) -> str:
    batteries = "" if plan.batteries is None else f", {plan.batteries} batteries"
    return f"{plan.mission}: J {plan.importance:.3f} after {plan.duration_s:.0f} s{batteries}"


def _draw_importance(axes: Axes, plan: Plan, run: Run) -> None:
    axes.plot(run.curves["time_s"], run.curves["importance"], color="#1f2933", linewidth=1.4)
    if plan.stop_below > 0:
        axes.axhline(plan.stop_below, color="#7a7a7a", linewidth=1, linestyle="--")
    for index, drone in enumerate(plan.drones):
        for swap in drone.swaps:  # one line of bars a drone, at the top
            height = 1.02 + 0.03 * index
            axes.plot([swap.start_s, swap.end_s], [height] * 2, color=drone_colour(index), linewidth=4)
    axes.set(ylabel="importance J (bars: on the ground)", ylim=(0, 1.05 + 0.03 * len(plan.drones)))
    axes.grid(alpha=0.3)


def _draw_batteries(axes: Axes, plan: Plan, run: Run, flight: Flight) -> None:
    for index, drone in enumerate(flight.drones):
        axes.plot(flight.time_s, 100 * flight.battery[:, index], color=drone_colour(index), label=f"drone {drone}")
    axes.axhline(100 * run.mission.vehicles.battery_critical, color="#c62828", linewidth=1, linestyle="--")
    axes.set(xlabel="mission time (s)", ylabel="battery left (%)", ylim=(0, 104), xlim=(0, max(plan.duration_s, 1.0)))
    axes.grid(alpha=0.3)
