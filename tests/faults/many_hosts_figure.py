"""The picture of a flight over many hosts: J, separation, and who was cut off when."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure

from faults.fleet_log import FleetLog
from faults.processes import Flight
from faults.witness import true_positions
from ground_station.separation import nearest_distances

SIZE_IN = (9.0, 6.0)
DPI = 120
FOR_GOOD = "computer lost"
SHADES = {"link cut": "tab:orange", FOR_GOOD: "tab:red"}
"""By part of the flight; one has no end."""


def draw(log: FleetLog, flight: Flight, path: Path) -> None:
    """All over mission time, shaded while something is wrong."""
    tick_s, drones = flight.mission.tick_s, [drone.id for drone in flight.mission.drones]
    figure = Figure(SIZE_IN, layout="constrained")
    falling, apart, ages = figure.subplots(3, 1, sharex=True)
    for drone in drones:
        heard = [each for each in log.heard if each.drone == drone]
        times_s = [each.tick * tick_s for each in heard]
        falling.plot(times_s, [each.importance for each in heard], label=f"drone {drone}", linewidth=1)
        ages.plot(times_s, [each.age_s * 1e3 for each in heard], ".", markersize=2)
    positions = list(true_positions(flight.run))
    nearest = [min(nearest_distances(dict(enumerate(places.tolist()))).values()) for _, places in positions]
    apart.plot([tick * tick_s for tick, _ in positions], nearest, color="black", linewidth=1)
    apart.axhline(flight.mission.flight.separation_m, color="tab:red", linestyle="--", linewidth=1, label="d")
    falling.set_ylabel("J of each replica")
    apart.set_ylabel("smallest distance [m]")
    apart.set_ylim(bottom=0)
    ages.set_ylabel("age of states\nat the ground [ms]")
    ages.set_yscale("log")
    ages.set_xlabel("mission time [s]")
    for axes in (falling, apart, ages):
        for phase in log.phases:
            if phase.name in SHADES:
                end = positions[-1][0] if phase.name == FOR_GOOD else phase.end.tick
                label = phase.name if axes is falling else None
                axes.axvspan(phase.begin.tick * tick_s, end * tick_s, color=SHADES[phase.name], alpha=0.2, label=label)
        axes.grid(alpha=0.3)
    falling.legend(loc="upper right", fontsize="small", ncols=3)
    apart.legend(loc="upper right", fontsize="small")
    figure.savefig(path, dpi=DPI)
