"""One mission with each source of poses, flown as ``covrecon run`` flies it: the mission table of docs/localization.md.

Two drones in random rooms, in lockstep with real processes: agents with their registrars, router, simulator, ground
station. `faults.localization_study` flies them.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import fmean

from faults.obstacle_study import WALLS_M
from faults.run_flight import run_flight
from protocol.localization_settings import EstimateNoise, Localization
from protocol.map_settings import Feedback
from protocol.mission import Drone, Flight, Mission, Simulation
from protocol.mission_file import mission_to_json
from protocol.operation_settings import Recording

NOISE = EstimateNoise(drift_m=0.05, drift_rad=0.01, velocity_mps=0.03, white_m=0.005, white_rad=0.002)
"""Of the vehicle: visual-inertial odometry or optical flow indoors. With KISS-ICP, of its velocity the same."""
ROOMS = (1, 2, 3)
TEAM = (Drone(id=1, start=(-1.0, 0.0, 2.0, 0.0, 1.3)), Drone(id=2, start=(1.0, 0.0, 2.0, 3.0, 1.3)))


@dataclass(frozen=True, slots=True)
class Source:
    """What tells drones where they are; its fields are settings of a mission."""

    localization: Localization = field(default_factory=Localization)
    estimate: EstimateNoise = field(default_factory=EstimateNoise)


SOURCES: Mapping[str, Source] = {
    "perfect pose": Source(),
    "vehicle's estimate with noise": Source(estimate=NOISE),
    "KISS-ICP fused": Source(Localization(source="lidar"), NOISE),
}
"""By the row's name. One more is one more line here."""


@dataclass(frozen=True, slots=True)
class Flown:
    """What came of one flight; poses are perfect where there is no error."""

    f_score_visible: float
    f_score_objects: float
    keyframes: int
    keyframes_unlocated: int
    min_separation_m: float
    pose_error_rms_m: float | None
    pose_error_max_m: float | None
    pose_error_beyond: float | None
    """Share of poses that were off by more than three told deviations."""


def mission_of(source: Source, room: int, seconds: int) -> Mission:
    corners = ((-WALLS_M, -WALLS_M), (WALLS_M, -WALLS_M), (WALLS_M, WALLS_M), (-WALLS_M, WALLS_M))
    return Mission(
        name="localization",
        duration_s=seconds,
        flight=Flight(boundary=corners),
        simulation=Simulation(scene=f"room-{room}", estimate=source.estimate),
        localization=source.localization,
        feedback=Feedback(method="none"),
        recording=Recording(enabled=False, report=False),
        drones=TEAM,
    )


def fly(folder: Path, name: str, room: int, seconds: int) -> Flown:
    """Flown now, or before."""
    place = folder / f"{name.replace(' ', '-')}-room-{room}-{seconds}"
    figures = place / "figures.json"
    if not figures.exists():
        place.mkdir(parents=True, exist_ok=True)
        mission = place / "mission.json"
        mission.write_text(mission_to_json(mission_of(SOURCES[name], room, seconds)))
        summary = json.loads((run_flight(mission) / "summary.json").read_text())
        flown = Flown(**{field: summary[field] for field in Flown.__slots__})
        figures.write_text(json.dumps(asdict(flown)))
    return Flown(**json.loads(figures.read_text()))


def fly_all(folder: Path, seconds: int) -> Iterator[str]:
    """Every source in every room; after each flight the table of what there is."""
    flown: dict[str, list[Flown]] = {name: [] for name in SOURCES}
    jobs = [(name, room) for room in ROOMS for name in SOURCES]
    for number, (name, room) in enumerate(jobs, start=1):
        flown[name].append(fly(folder, name, room, seconds))
        print(f"{number}/{len(jobs)} room-{room}, {name}: {flown[name][-1]}", file=sys.stderr, flush=True)
        yield "\n".join(table(flown, seconds))


def table(flown: Mapping[str, Sequence[Flown]], seconds: int) -> Iterator[str]:
    """Markdown; by the name of the source, of each room in turn."""
    yield (
        f"| {len(TEAM)} drones, {seconds} s | rooms | F visible: mean (each) | F objects: mean | keyframes | left out"
        " | error rms / max, cm | beyond 3 told | least separation, m |"
    )
    yield "|---|---|---|---|---|---|---|---|---|"
    for name, flights in flown.items():
        if flights:
            each = ", ".join(f"{flight.f_score_visible:.3f}" for flight in flights)
            yield (
                f"| {name} | {len(flights)} | {fmean(flight.f_score_visible for flight in flights):.3f} ({each})"
                f" | {fmean(flight.f_score_objects for flight in flights):.3f}"
                f" | {sum(flight.keyframes for flight in flights)}"
                f" | {sum(flight.keyframes_unlocated for flight in flights)} | {_errors(flights)}"
                f" | {min(flight.min_separation_m for flight in flights):.2f} |"
            )


def _errors(flights: Sequence[Flown]) -> str:
    squares = [flight.pose_error_rms_m**2 for flight in flights if flight.pose_error_rms_m is not None]
    most = [flight.pose_error_max_m for flight in flights if flight.pose_error_max_m is not None]
    beyond = [flight.pose_error_beyond for flight in flights if flight.pose_error_beyond is not None]
    if not (squares and most and beyond):
        return "– / – | –"
    return f"{100 * fmean(squares) ** 0.5:.1f} / {100 * max(most):.1f} | {fmean(beyond):.1%}"
