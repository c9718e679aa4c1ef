"""What the ground station may expect of every kind of map feedback."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
import pytest

from faults.meshes import Block, furnished, of_points, shuffled, together
from ground_station.mesh_change import MeshChange
from ground_station.mesh_change_choice import make_mesh_change
from ground_station.reconstruction.reconstructor import Mesh
from protocol.errors import ReconstructionError
from protocol.field import VirtualField
from protocol.geometry import Floats
from protocol.map_settings import Feedback
from protocol.mission import Drone, Mission, Target

TARGET = Target(lower_m=(-1.0, -0.8, 0.0), upper_m=(1.1, 0.8, 0.9))
FIELD = VirtualField.of(TARGET)
TABLE, STOOL = Block((-0.4, 0.1, 0.2), (0.3, 0.4, 0.2)), Block((0.6, -0.3, 0.15), (0.15, 0.15, 0.15))
BEFORE, AFTER = furnished(TARGET, (TABLE,)), furnished(TARGET, (TABLE, STOOL))
Method = Literal["grid", "m3c2"]
Normalisation = Literal["sum", "mean"]
NewChange = Callable[..., MeshChange]


@pytest.fixture(params=["grid", "m3c2"])
def new(request: pytest.FixtureRequest) -> NewChange:
    """Makes a new one of the kind, with the given normalisation."""

    def make(normalisation: Normalisation = "mean") -> MeshChange:
        feedback = Feedback(method=request.param, normalisation=normalisation)
        drones = (Drone(id=1, start=(0, 0, 2, 0, 1.4)),)
        return make_mesh_change(Mission(target=TARGET, feedback=feedback, drones=drones), FIELD)

    return make


def gap_to(place: tuple[float, ...]) -> Floats:
    """Of every position of the field, m."""
    return np.asarray(np.linalg.norm(FIELD.positions() - place, axis=1))


@pytest.mark.parametrize("normalisation", ["sum", "mean"])
def test_growth_raises_the_importance_most_where_it_grew(new: NewChange, normalisation: Normalisation) -> None:
    change = new(normalisation)
    change.update(BEFORE)
    h2 = change.update(AFTER)
    assert (h2.dtype, h2.shape) == (np.float32, (FIELD.shape[0],))
    assert h2.min() >= 0
    assert gap_to(STOOL.centre)[h2.argmax()] < 0.3
    assert h2[gap_to(STOOL.centre) < 0.3].mean() > 10 * h2[gap_to(STOOL.centre) > 1.2].mean()


def test_floor_that_is_seen_for_the_first_time_raises_the_importance(new: NewChange) -> None:
    change = new()
    change.update(furnished(TARGET, seen_to_x=0.0))
    h2 = change.update(furnished(TARGET))
    x, z = FIELD.positions()[:, 0], FIELD.positions()[:, 2]
    low = z == z.min()
    assert h2[low & (x > 0.3)].min() > 5 * h2[low & (x < -0.7)].max() > 0


def test_the_same_surface_gives_no_feedback_in_whatever_order_its_vertices_come(new: NewChange) -> None:
    change = new()
    assert change.update(AFTER).max() > 0
    assert not change.update(AFTER).any()
    assert not change.update(shuffled(AFTER)).any()


def test_the_first_mesh_is_compared_with_an_empty_one(new: NewChange) -> None:
    emptied, first = new(), new()
    assert not emptied.update(Mesh.empty()).any()
    np.testing.assert_array_equal(emptied.update(BEFORE), first.update(BEFORE))


def test_a_mesh_that_vanished_counts_like_one_that_appeared(new: NewChange) -> None:
    change = new()
    np.testing.assert_array_equal(change.update(BEFORE), change.update(Mesh.empty()))


@pytest.mark.parametrize("height_m", [3.0, -0.18])
def test_what_lies_outside_the_target_is_ignored(new: NewChange, height_m: float) -> None:
    """A surface in the target's face may scatter to either side of it; this one is farther away."""
    floor = furnished(TARGET)
    far = Mesh(floor.vertices + np.float32([0, 0, height_m]), floor.faces, floor.colors)
    change, without = new(), new()
    np.testing.assert_array_equal(change.update(together(BEFORE, far)), without.update(BEFORE))
    assert not change.update(BEFORE).any()


def test_mean_feedback_never_exceeds_one(new: NewChange) -> None:
    crowded = [Block((x, y, 0.3), (0.08, 0.08, 0.3)) for x in np.arange(-0.9, 1, 0.3) for y in np.arange(-0.7, 1, 0.3)]
    h2 = new("mean").update(furnished(TARGET, crowded))
    assert 0.1 < h2.max() <= 1


def test_the_same_meshes_give_the_same_bytes(new: NewChange) -> None:
    results = []
    for _ in range(2):
        change = new()
        results.append([change.update(mesh).tobytes() for mesh in (BEFORE, AFTER, shuffled(BEFORE))])
    assert results[0] == results[1]


def broken() -> list[tuple[Mesh, str]]:
    holed = BEFORE.vertices.copy()
    holed[7, 1] = np.nan
    endless = BEFORE.vertices.copy()
    endless[7, 1] = np.inf
    return [
        (of_points(BEFORE.vertices[:, :2]), r"vertices must be \(N, 3\), got"),
        (Mesh(BEFORE.vertices, BEFORE.faces.ravel(), BEFORE.colors), r"faces must be \(N, 3\), got"),
        (Mesh(holed, BEFORE.faces, BEFORE.colors), "vertices are not finite"),
        (Mesh(endless, BEFORE.faces, BEFORE.colors), "vertices are not finite"),
        (Mesh(BEFORE.vertices[:-1], BEFORE.faces, BEFORE.colors), "a face has a vertex that is none of the"),
        (Mesh(BEFORE.vertices, BEFORE.faces - 1, BEFORE.colors), "a face has a vertex that is none of the"),
    ]


@pytest.mark.parametrize(("mesh", "message"), broken())
def test_what_is_no_mesh_is_refused_and_the_mesh_before_it_kept(new: NewChange, mesh: Mesh, message: str) -> None:
    change = new()
    change.update(BEFORE)
    with pytest.raises(ReconstructionError, match=message):
        change.update(mesh)
    assert not change.update(BEFORE).any()
