"""Which flights a study is made of, and the mission of each.

Flights of one seed begin alike whatever the method: the seed moves and turns the drones at the start, and makes the
noise of their cameras. From one start alone, flights would differ by that noise only, which tells little of a method.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import platform
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, get_args

import numpy as np

from ground_station.replay.settings import value_of
from ground_station.results import versions
from ground_station.study.plan_file import Method, Plan, PlannedFlight, PlannedMap, Study
from protocol.errors import MissionError
from protocol.mission import Drone, Mission
from protocol.mission_faults import check
from protocol.mission_file import load_mission, mission_to_json

METHODS: Final[Mapping[Method, tuple[str, str]]] = {
    "lawnmower": ("lawnmower", "none"),
    "persistent": ("persistent", "none"),
    "angle_aware_down": ("angle_aware_down", "none"),
    "angle_aware": ("angle_aware", "none"),
    "none": ("coverage", "none"),
    "grid": ("coverage", "grid"),
    "m3c2": ("coverage", "m3c2"),
}
"""By method: ``controller.planner`` and ``feedback.method``."""
ALL_METHODS: Final[tuple[Method, ...]] = get_args(Method)
CONTRASTED: Final[tuple[Method, ...]] = ("none", "grid")
"""What tells whether feedback helps."""
TEAMS: Final = (2, 4)
"""Drones of grid feedback's teams, beside the single one (paper)."""
PORTRAYED: Final = (0.3, 0.7)
"""J_th of grid feedback's phase portraits, beside the mission's own."""
SHIFT: Final = 0.2
"""How far a seed moves a drone at the start along x and y each, in separations: drones of the start formation, 1.5
separations apart, stay 1.1 apart."""
STARTS_STREAM: Final = 7
"""Keeps the draws of starts apart from others that are made from the same seed."""


@dataclass(frozen=True, slots=True)
class Wish:
    """What a study's flights have in common."""

    mission: Path
    duration_s: float
    seeds: int
    """As many, from 1 on."""
    settings: Mapping[str, Any]
    """Replaces those of the mission, by dotted name."""


@dataclass(frozen=True, slots=True)
class Job:
    planned: PlannedFlight
    mission: Mission


def paper_jobs(wish: Wish, methods: Sequence[Method]) -> list[Job]:
    """Every method with one drone; of grid feedback also the teams, and the thresholds of the phase portraits.

    Raises `MissionError`.
    """
    kinds: list[tuple[Method, int, float | None]] = [(method, 1, None) for method in methods]
    if "grid" in methods:
        kinds += [("grid", drones, None) for drones in TEAMS]
        kinds += [("grid", 1, threshold) for threshold in PORTRAYED]
    return once(
        job_of(wish, method, drones=drones, seed=seed, threshold=threshold)
        for seed in range(1, wish.seeds + 1)
        for method, drones, threshold in kinds
    )


def feedback_jobs(wish: Wish, scenes: Sequence[str]) -> list[Job]:
    """One drone without feedback and one with the grid's, in each scene. Raises `MissionError`."""
    return once(
        job_of(wish, method, seed=seed, scene=scene)
        for seed in range(1, wish.seeds + 1)
        for scene in scenes
        for method in CONTRASTED
    )


def once(jobs: Iterable[Job]) -> list[Job]:
    """Without those that come to the same."""
    return list({job.planned.key: job for job in jobs}.values())


def plan_of(study: Study, wish: Wish, jobs: Sequence[Job], command: str, maps: Sequence[PlannedMap] = ()) -> Plan:
    return Plan(
        study=study,
        command=command,
        machine=f"{cores()} cores, {platform.machine()}, Python {platform.python_version()}",
        duration_s=wish.duration_s,
        flights=tuple(job.planned for job in jobs),
        maps=tuple(maps),
    )


def cores() -> int:
    """That this process may use."""
    return len(os.sched_getaffinity(0))


def assignments(texts: Sequence[str]) -> dict[str, Any]:
    """Settings like ``feedback.kappa=0.5`` by dotted name; a value is TOML, or a bare word for a text.

    Raises `MissionError`.
    """
    found: dict[str, Any] = {}
    for text in texts:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not (equals and name):
            raise MissionError([f"{text}: must be like feedback.kappa=0.5"])
        found[name] = value_of(value)
    return found


def job_of(
    wish: Wish,
    method: Method,
    *,
    seed: int,
    drones: int = 1,
    threshold: float | None = None,
    scene: str | None = None,
    more: Mapping[str, Any] | None = None,
) -> Job:
    """``more``: settings that belong to the study, and that nobody's wish changes."""
    planner, feedback = METHODS[method]
    replaced: dict[str, Any] = {
        "duration_s": wish.duration_s,
        "stop_below": 0.0,
        # What nobody looks at: one that is cut short is flown anew, and the study has its own report.
        "recording.enabled": False,
        "recording.report": False,
        "replication.checkpoint_period_s": wish.duration_s,
        **wish.settings,
        "controller.planner": planner,
        "feedback.method": feedback,
        **(more or {}),
    }
    if threshold is not None:
        replaced["feedback.threshold"] = threshold
    if scene is not None:
        replaced["simulation.scene"] = scene
    mission = started_by_seed(load_mission(wish.mission, drones=drones, seed=seed, replaced=replaced))
    planned = PlannedFlight(
        method=method,
        drones=drones,
        threshold=mission.feedback.threshold,
        scene=Path(mission.simulation.scene).stem,
        seed=seed,
        contrast=mission.simulation.texture_contrast,
        key=key_of(mission),
    )
    return Job(planned, mission)


def key_of(mission: Mission) -> str:
    """Equal for flights that come to the same: of the effective mission, and of all versions that may matter."""
    told = mission_to_json(mission) + json.dumps(versions(), sort_keys=True)
    return hashlib.sha256(told.encode()).hexdigest()


def started_by_seed(mission: Mission) -> Mission:
    """The mission with each drone moved by up to `SHIFT` separations along x and y, and turned to any yaw.

    A drone's draws do not depend on how many others there are, nor on the method. Raises `MissionError` if drones that
    the mission places come too near to each other.
    """
    drones = tuple(_moved(mission, drone, draws) for drone, draws in zip(mission.drones, _draws(mission), strict=True))
    return _checked(mission, drones)


def _draws(mission: Mission) -> Iterator[tuple[float, float, float]]:
    generator = np.random.default_rng([mission.seed, STARTS_STREAM])
    for _ in mission.drones:
        x, y, turn = generator.uniform(-1.0, 1.0, 3).tolist()
        yield x, y, turn


def _moved(mission: Mission, drone: Drone, draws: tuple[float, float, float]) -> Drone:
    reach = SHIFT * mission.flight.separation_m
    x, y, z, _, pitch = drone.start
    flight = mission.flight
    moved = [
        min(max(at + reach * draw, low), high)
        for at, draw, low, high in zip((x, y), draws, flight.lower_m, flight.upper_m, strict=False)
    ]
    return drone.model_copy(update={"start": (moved[0], moved[1], z, math.pi * draws[2], pitch)})


def _checked(mission: Mission, drones: tuple[Drone, ...]) -> Mission:
    raw = mission.model_dump(mode="json") | {"drones": [drone.model_dump(mode="json") for drone in drones]}
    changed, faults = check(raw)
    if changed is None or faults:
        raise MissionError([f"seed {mission.seed}: {fault.key}: {fault.message}" for fault in faults])
    return changed
