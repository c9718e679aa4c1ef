"""The random-room suite: which rooms are flown through under which textures, and which maps are made of each flight.

One flight gives the same keyframes to every way of making a map, so ways differ by nothing else.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, get_args

from deploy.bench.plan import Job, Wish, job_of, once
from ground_station.rebuild.quality import QUALITIES, Quality
from ground_station.results import versions
from ground_station.study.plan_file import PlannedMap
from protocol.errors import MissionError
from protocol.guard import ROOT

FIRST_ROOM: Final = 901
"""Rooms from here on are held out: what learns from random rooms must leave them alone."""
DRONES: Final = 4
"""Cover a room in a third of one drone's time, and an agent's tick costs less than the simulator's."""
COVERED: Final = 0.05
"""J at which a flight ends: four drones take about 135 s to it, for some 1,700 keyframes."""
LONGEST_S: Final = 300.0
"""A flight ends after this also if J is not there."""
TABLE: Final = "reconstruction."
"""Settings of this table are for the maps, not for the flights: those are flown once."""
CODE: Final = (
    "ground_station/reconstruction",
    "ground_station/rebuild",
    "ground_station/evaluate",
    "ground_station/evaluation.py",
    "ground_station/mapper.py",
)
"""What a map and its figures depend on, weights included: maps are made again when it changes, and nothing is flown."""
OWN: Final[Mapping[str, Sequence[str]]] = {
    "learned": ("ground_station/reconstruction/learned",),
    "depth": ("ground_station/reconstruction/depth_reconstructor.py",),
}
"""What no backend but the one of this name depends on: new weights cost the other maps nothing."""


@dataclass(frozen=True, slots=True)
class MapJob:
    planned: PlannedMap
    backend: str
    quality: Quality
    settings: tuple[str, ...]
    """Like ``reconstruction.voxel_m=0.02``."""


def room_jobs(wish: Wish, contrasts: Sequence[float]) -> list[Job]:
    """``wish.seeds`` rooms, each under every texture contrast. Raises `MissionError`."""
    flown = {name: value for name, value in wish.settings.items() if not name.startswith(TABLE)}
    return once(
        job_of(
            replace(wish, settings=flown),
            "none",
            drones=DRONES,
            seed=room,
            scene=f"room-{room}",
            more={
                "stop_below": COVERED,
                "simulation.texture_contrast": contrast,
                "reconstruction.backend": "none",
                "camera.depth": True,  # for ways that begin from it
            },
        )
        for room in range(FIRST_ROOM, FIRST_ROOM + wish.seeds)
        for contrast in contrasts
    )


def map_jobs(jobs: Sequence[Job], ways: Sequence[str], settings: Mapping[str, Any]) -> list[MapJob]:
    """Each way of making a map of each flight. Raises `MissionError` for a way that names no quality there is."""
    chosen = tuple(f"{name}={json.dumps(value)}" for name, value in settings.items() if name.startswith(TABLE))
    parts = {way: _parts(way) for way in ways}
    keys = {way: _key(way, chosen, _code_digest(backend)) for way, (backend, _) in parts.items()}
    return [
        MapJob(PlannedMap(flight=job.planned, way=way, key=keys[way]), *parts[way], chosen)
        for job in jobs
        for way in ways
    ]


def _parts(way: str) -> tuple[str, Quality]:
    backend, _, name = way.partition(":")
    for quality in get_args(Quality):
        if quality == (name or "flown"):
            return backend, quality
    raise MissionError([f"{way}: {name} is no quality; there are {', '.join(QUALITIES)}"])


def _key(way: str, settings: Sequence[str], code: str) -> str:
    told = json.dumps([way, sorted(settings), versions(), code], sort_keys=True)
    return hashlib.sha256(told.encode()).hexdigest()


def _code_digest(backend: str) -> str:
    """Of all code that a map of this backend depends on."""
    others = [ROOT / name for owner, names in OWN.items() if owner != backend for name in names]
    digest = hashlib.sha256()
    for file in _sources():
        if any(file.is_relative_to(other) for other in others):
            continue
        digest.update(file.read_bytes())
    return digest.hexdigest()


def _sources() -> Iterator[Path]:
    for name in CODE:
        place = ROOT / name
        found = [place] if place.is_file() else sorted(place.rglob("*"))
        yield from (file for file in found if file.is_file() and file.parent.name != "__pycache__")
