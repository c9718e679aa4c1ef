"""What a perfect map of the scene would hold, as files: the ground station knows nothing of the simulator.

Surface that nobody can see must not count: the backs and insides of furniture. Rays sort it out. *Exposed* is what
some point in the open sees; *visible* is what a camera can see from where this mission lets its drones fly.
"""

from __future__ import annotations

import hashlib
import json
import logging
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from protocol.airspace import airspace_of
from protocol.errors import SceneError
from protocol.geometry import Floats
from protocol.mission import Flight, Mission
from sim_bridge.scenes.cropping import crop_to_box
from sim_bridge.scenes.ply import write_ply
from sim_bridge.scenes.scene import Scene, replace_file, source_digest
from sim_bridge.scenes.things import thing_at, things_of
from sim_bridge.scenes.visibility import exposed_points, visible_points

log = logging.getLogger(__name__)

MESH_FILE = "truth.ply"
SAMPLES_FILE = "truth_samples.npz"
SAMPLES_PER_M2 = 3500.0
"""One every 1.7 cm, a third of the 5 cm at which maps are scored; as in the prototype."""
SEED = 5
FLOOR_M = 0.02
"""Surface lower than this over B's lower face is called floor in the log; rugs are thinner."""


@dataclass(frozen=True, slots=True)
class Truth:
    """The scene's surface inside B, sampled uniformly."""

    points: NDArray[np.float32]
    """[N, 3] metres."""
    exposed: NDArray[np.bool_]
    """[N] seen from some point in the open."""
    visible: NDArray[np.bool_]
    """[N] seen from a pose that the mission allows; implies exposed."""
    thing: NDArray[np.int32]
    """[N] which of ``names`` it is part of, or `sim_bridge.scenes.things.NO_THING`."""
    names: tuple[str, ...]


def write_truth(scene: Scene, mission: Mission, folder: Path, *, cache: Path) -> Truth:
    """Write ``truth.ply`` (the mesh inside B, coloured) and ``truth_samples.npz`` (the fields of `Truth`, and ``box``,
    B's two corners [2, 3]).

    The samples are kept under ``cache``, by the scene and the mission values they depend on. Raises `SceneError`
    if no surface lies inside B.
    """
    corners, weights, source = crop_to_box(scene.triangles, mission.target.lower_m, mission.target.upper_m)
    if not len(corners):
        box = f"{mission.target.lower_m} to {mission.target.upper_m}"
        raise SceneError(f"{mission.simulation.scene}: no surface inside the target box {box}")
    folder.mkdir(parents=True, exist_ok=True)
    write_ply(folder / MESH_FILE, corners, _colours(scene, weights, source))

    kept = cache / f"truth-{_key(scene, mission)}.npz"
    truth = _read(kept) if kept.exists() else None
    if truth is None:
        truth = _sample(scene, mission, corners, source)
        _write(kept, truth, mission)
    _write(folder / SAMPLES_FILE, truth, mission)
    floor = truth.points[:, 2] < mission.target.lower_m[2] + FLOOR_M
    for name, seen in (("exposed", truth.exposed), ("visible", truth.visible)):
        share = float(floor[seen].mean()) if seen.any() else 0.0
        log.info("truth: %.1f m2 %s, %.0f %% of it floor", seen.sum() / SAMPLES_PER_M2, name, 100 * share)
    return truth


def _sample(scene: Scene, mission: Mission, corners: Floats, source: NDArray[np.int64]) -> Truth:
    rng = np.random.default_rng(SEED)
    across, up = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    areas = np.linalg.norm(np.cross(across, up), axis=1) / 2
    bounds = np.cumsum(areas)
    count = round(float(bounds[-1]) * SAMPLES_PER_M2)
    # One sample in each of `count` equal strata of the area: even, and still uniform.
    row = np.searchsorted(bounds, (np.arange(count) + rng.random(count)) * (bounds[-1] / count))
    row = np.minimum(row, len(corners) - 1)
    a, b = rng.random((2, count, 1))
    folded = a + b > 1
    a, b = np.where(folded, 1 - a, a), np.where(folded, 1 - b, b)
    points = (corners[row, 0] + a * across[row] + b * up[row]).astype(np.float32)
    exposed = exposed_points(scene, mission.target, points, source[row])
    visible = np.zeros(count, dtype=np.bool_)
    visible[exposed] = visible_points(scene, mission, points[exposed], source[row][exposed])
    things = things_of(mission.simulation.scene)
    return Truth(points, exposed, visible, thing_at(points, things), tuple(thing.name for thing in things))


def _colours(scene: Scene, weights: Floats, source: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Colour of each corner, [n, 3, 3]: the texture, as coarse as the triangle is large, times the light."""
    uv = np.einsum("nij,njk->nik", weights, scene.uv[source].astype(np.float64))
    light = np.einsum("nij,njk->nik", weights, scene.light[source].astype(np.float64))
    textures, texture = scene.textures, scene.texture[source]
    size = textures.sizes[texture].astype(np.int64)
    edges = np.diff(scene.uv[source].astype(np.float64), axis=1) * size[:, None, :2]
    texels = np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0])
    level = np.clip(np.log2(np.maximum(texels, 1.0)) / 2 - 1, 0, size[:, 2] - 1).astype(np.int64)
    width, height = np.maximum(1, size[:, 0] >> level)[:, None], np.maximum(1, size[:, 1] >> level)[:, None]
    column, row = (
        np.floor(uv[..., 0] * width).astype(np.int64) % width,
        np.floor(uv[..., 1] * height).astype(np.int64) % height,
    )
    packed = textures.texels[textures.offsets[texture, level][:, None] + row * width + column]
    colour = np.stack([packed & 255, packed >> 8 & 255, packed >> 16 & 255], axis=-1)
    lit: NDArray[np.uint8] = np.clip(colour * light + 0.5, 0, 255).astype(np.uint8)
    return lit


def _key(scene: Scene, mission: Mission) -> str:
    flight, camera = mission.flight, mission.camera
    values = [
        scene.fingerprint,
        source_digest("truth", "visibility", "cropping", "things"),
        (mission.target.lower_m, mission.target.upper_m),
        (flight.lower_m, flight.upper_m, flight.pitch_limits_rad),
        _zones(mission.flight),
        (camera.horizontal_fov_rad, camera.height_px / camera.width_px),
    ]
    return hashlib.sha256(json.dumps(values).encode()).hexdigest()[:16]


def _zones(flight: Flight) -> list[object]:
    """What `airspace_of` is made of."""
    if airspace_of(flight).is_open:
        return []
    zones = [zone.model_dump() for zone in flight.no_fly]
    return [flight.boundary, zones, airspace_of(flight).distance_m, airspace_of(flight).wide_m]


def _read(path: Path) -> Truth | None:
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
            names = tuple(data["names"].tolist())
            return Truth(data["points"], data["exposed"], data["visible"], data["thing"], names)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        log.warning("%s is damaged (%s): sampling the truth again", path, error)
        return None


def _write(path: Path, truth: Truth, mission: Mission) -> None:
    with replace_file(path) as file:
        np.savez(
            file,
            points=truth.points,
            exposed=truth.exposed,
            visible=truth.visible,
            thing=truth.thing,
            names=np.array(truth.names, dtype=np.str_),
            box=np.array([mission.target.lower_m, mission.target.upper_m]),
        )
