"""The flights of a study: planned by ``covrecon bench``, read by whoever makes tables and figures of them.

A study's folder holds ``plan.json`` and ``flights/<folder of a flight>``. A flight's folder appears when it is flown to
its end, in one step; so what is there is whole.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, ValidationError

from ground_station.durable import replace_file
from protocol.errors import StorageError

PLAN_FILE = "plan.json"
FLIGHTS_FOLDER = "flights"
TRUTH_MESH_FILE = "truth.ply"
"""The scene's own surface, which the simulator leaves in a run's folder."""

MAPS_FOLDER = "maps"
FIGURES_FILE = "figures.json"
"""Of a map's folder; it holds either figures, or the ``reason`` why there are none."""

Study: TypeAlias = Literal["paper", "feedback", "reconstruction"]
Method: TypeAlias = Literal["lawnmower", "persistent", "angle_aware_down", "angle_aware", "none", "grid", "m3c2"]
"""How drones decide where to fly: a planner of others, or this controller with one kind of feedback."""

Series: TypeAlias = tuple[str, Method, int, float]
"""Scene, method, drones and J_th: what flights of different seeds have in common."""


class PlannedFlight(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    method: Method
    drones: int
    threshold: float
    """J_th."""
    scene: str
    seed: int
    contrast: float = 1.0
    """Of the scene's textures."""
    key: str
    """Of all that its result depends on: settings and versions."""

    @property
    def name(self) -> str:
        """For people."""
        parts = [self.method, f"x{self.drones}", f"th{100 * self.threshold:.0f}", Path(self.scene).stem]
        parts += [f"texture{100 * self.contrast:g}"] if self.contrast != 1.0 else []
        return "-".join([*parts, f"seed{self.seed}"])

    @property
    def folder(self) -> str:
        """Under `FLIGHTS_FOLDER`; another key is another folder, so nothing that was flown is written over."""
        return f"{self.name}-{self.key[:12]}"

    @property
    def series(self) -> Series:
        return self.scene, self.method, self.drones, self.threshold


class PlannedMap(BaseModel):
    """A map that is made after a flight from what it photographed."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    flight: PlannedFlight
    way: str
    """How: a backend, or a backend and a quality (`ground_station.rebuild.quality`) with a colon between."""
    key: str
    """Of all that it depends on beside the flight: settings, versions and the reconstruction's code."""

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.flight.name}-{self.way.replace(':', '-')}"

    @property
    def folder(self) -> str:
        """Under `MAPS_FOLDER`."""
        return f"{self.name}-{self.flight.key[:6]}{self.key[:6]}"


class Plan(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    study: Study
    command: str
    """By which it is flown, for people."""
    machine: str
    """On which it is flown, likewise."""
    duration_s: float
    """Mission time of each flight."""
    flights: tuple[PlannedFlight, ...]
    maps: tuple[PlannedMap, ...] = ()

    @property
    def series(self) -> list[Series]:
        """In the order of the plan."""
        return list(dict.fromkeys(flight.series for flight in self.flights))


def write_plan(folder: Path, plan: Plan) -> None:
    """Raises `StorageError`."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        replace_file(folder / PLAN_FILE, [(plan.model_dump_json(indent=2) + "\n").encode()])
    except OSError as error:
        raise StorageError(f"{folder / PLAN_FILE}: {error.strerror}") from error


def read_plan(folder: Path) -> Plan:
    """Raises `StorageError` if there is none that can be read."""
    path = folder / PLAN_FILE
    try:
        return Plan.model_validate_json(path.read_bytes())
    except OSError as error:
        raise StorageError(f"{path}: {error.strerror}; is this the folder of a study?") from error
    except ValidationError as error:
        raise StorageError(f"{path}: {error}") from error
