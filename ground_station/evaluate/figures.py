"""The figures of one map: F-scores beside a bare floor's, distances, and what was found of each piece of furniture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ground_station.evaluate.reference import Reference
from ground_station.evaluation import (
    FULL_SAMPLES,
    NO_THING,
    OBJECT_MESH_M,
    OBJECT_TRUTH_M,
    THRESHOLD_M,
    Faces,
    Mask,
    Score,
    Scores,
    Vertices,
    floor_baseline,
    near_surface,
    sample_surface,
    score,
)

SEED: Final = 1
"""Of the points drawn on the map for distances; as repeatable as scores."""
DECIMALS: Final = 6
"""Of figures in JSON: micrometres."""


@dataclass(frozen=True, slots=True)
class Distances:
    """Mean distances in metres, not cut off at any threshold; None where there is nothing to measure from or to."""

    to_truth_m: float | None
    """From the map to the true surface: how wrong it is."""
    to_map_m: float | None
    """From the true visible surface to the map: how much it lacks."""

    @property
    def chamfer_m(self) -> float | None:
        """Their sum, as Open3D's compute_metrics has it."""
        return None if self.to_truth_m is None or self.to_map_m is None else self.to_truth_m + self.to_map_m


@dataclass(frozen=True, slots=True)
class ThingScore:
    """What was found of one piece of furniture, without what lies as low as the floor."""

    name: str
    share: float
    """Of all furniture's visible surface."""
    score: Score
    """Precision: of the map that lies nearest to it. Recall: of its visible surface."""


@dataclass(frozen=True, slots=True)
class Evaluation:
    scores: Scores
    floor: Scores
    """What a bare floor scores."""
    distances: Distances
    things: tuple[ThingScore, ...]
    """Empty where the truth does not know the furniture."""
    threshold_m: float
    triangles: int
    """Of the map."""

    def as_json(self) -> dict[str, Any]:
        things = [{"name": thing.name, "share": thing.share, **asdict(thing.score)} for thing in self.things]
        told = {
            "threshold_m": self.threshold_m,
            "triangles": self.triangles,
            **asdict(self.scores),
            "floor": asdict(self.floor),
            "chamfer_m": self.distances.chamfer_m,
            **asdict(self.distances),
            "things": things,
        }
        rounded: dict[str, Any] = _rounded(told)
        return rounded


def evaluate(vertices: Vertices, faces: Faces, reference: Reference, threshold_m: float = THRESHOLD_M) -> Evaluation:
    """Of the map ``vertices`` (V, 3) metres, ``faces`` (F, 3). Same arguments, same result."""
    truth, box = reference.truth, reference.box
    return Evaluation(
        scores=score(vertices, faces, truth, box, threshold_m),
        floor=floor_baseline(truth, box, threshold_m),
        distances=_distances(vertices, faces, reference, threshold_m),
        things=things_found(vertices, faces, reference, threshold_m),
        threshold_m=threshold_m,
        triangles=len(faces),
    )


def distances_to(points: NDArray[np.floating], vertices: Vertices, faces: Faces) -> NDArray[np.float32]:
    """Metres from each of ``points`` (N, 3) to the nearest triangle, (N,); infinite without triangles."""
    import open3d as o3d

    if not len(faces) or not len(points):
        return np.full(len(points), np.inf, np.float32)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor.from_numpy(vertices), o3d.core.Tensor.from_numpy(faces.astype(np.uint32)))
    asked = o3d.core.Tensor.from_numpy(np.ascontiguousarray(points, dtype=np.float32))
    found: NDArray[np.float32] = scene.compute_distance(asked).numpy()
    return found


def things_found(vertices: Vertices, faces: Faces, reference: Reference, threshold_m: float) -> tuple[ThingScore, ...]:
    """Each piece of furniture that has visible surface above the floor, the largest first."""
    truth, floor = reference.truth, reference.box.lower_m[2]
    drawn = _drawn(vertices, faces, reference, threshold_m)
    drawn = drawn[drawn[:, 2] > floor + OBJECT_MESH_M]
    apart, nearest = truth.tree.query(drawn) if len(drawn) else (np.empty(0), np.empty(0, np.int64))
    owner, right = truth.thing[nearest], np.asarray(apart) <= threshold_m
    counted: Mask = truth.visible & (truth.points[:, 2] > floor + OBJECT_TRUTH_M) & (truth.thing != NO_THING)
    counted &= _inside(truth.points, reference)
    points, thing = truth.points[counted], truth.thing[counted]
    above = faces[(vertices[:, 2] > floor + OBJECT_MESH_M)[faces].any(axis=1)]
    found = near_surface(points, vertices, above, threshold_m)
    rows = []
    for number, name in enumerate(truth.names):
        own, of_map = thing == number, owner == number
        if own.any():
            precision = float(right[of_map].mean()) if of_map.any() else 0.0
            rows.append(ThingScore(name, float(own.mean()), Score.of(precision, float(found[own].mean()))))
    return tuple(sorted(rows, key=lambda row: -row.share))


def _distances(vertices: Vertices, faces: Faces, reference: Reference, threshold_m: float) -> Distances:
    drawn = _drawn(vertices, faces, reference, threshold_m)
    truth = reference.truth
    step = max(1, len(truth.points) // FULL_SAMPLES)
    seen = truth.points[(truth.visible & _inside(truth.points, reference))][::step]
    return Distances(
        to_truth_m=_mean(distances_to(drawn, reference.vertices, reference.faces)),
        to_map_m=_mean(distances_to(seen, vertices, faces)),
    )


def _drawn(vertices: Vertices, faces: Faces, reference: Reference, threshold_m: float) -> NDArray[np.float64]:
    """Points spread over the map in the box, and within the threshold around it, as scores take them."""
    points = sample_surface(vertices, faces, FULL_SAMPLES, np.random.default_rng(SEED))
    lower, upper = np.array(reference.box.lower_m), np.array(reference.box.upper_m)
    return points[np.all((points >= lower - threshold_m) & (points <= upper + threshold_m), axis=1)]


def _inside(points: Vertices, reference: Reference) -> Mask:
    lower, upper = np.array(reference.box.lower_m), np.array(reference.box.upper_m)
    inside: Mask = np.all((points >= lower) & (points <= upper), axis=1)
    return inside


def _mean(distances: NDArray[np.float32]) -> float | None:
    mean = float(distances.mean(dtype=np.float64)) if len(distances) else np.inf
    return mean if np.isfinite(mean) else None


def _rounded(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _rounded(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_rounded(each) for each in value]
    return round(value, DECIMALS) if isinstance(value, float) else value
