"""What the ground station may expect of any reconstructor, and what the default one finds of two boxes on a floor."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from deploy.examples.external_map import PlaneSweepMap
from faults.boxes import BOXES, LEG, NEAR_M, REFINED, fly_over, mission, share_right
from faults.external_process import served
from ground_station.reconstruction.backends import make_reconstructor
from ground_station.reconstruction.learned.requirements import MODULES
from ground_station.reconstruction.reconstructor import Keyframe, Mesh, Outcome, Reconstructor
from protocol.errors import ReconstructionError
from protocol.geometry import Floats, Intrinsics, camera_rotation, turn_matrix
from protocol.mission import Target
from protocol.obstacle_grid import ObstacleGrid

Make = Callable[[], Reconstructor]
MAPPING = ("plane_sweep", "depth", "external")
"""Backends that make a map."""
LEARNED = pytest.param(
    "learned",
    marks=pytest.mark.skipif(
        any(find_spec(name) is None for name in MODULES), reason="the extra learned is not installed"
    ),
)
BACKENDS = (*MAPPING, "plane_sweep" + REFINED, LEARNED, "none")
mapping = pytest.mark.parametrize("backend", MAPPING, indirect=True)


@pytest.fixture(scope="module")
def flight() -> list[Keyframe]:
    return fly_over()


@pytest.fixture(params=BACKENDS)
def backend(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def make(backend: str, tmp_path: Path) -> Iterator[Make]:
    """New ones of the backend; of the external one, with the same process behind all."""
    own = mission(backend)
    if backend == "external":
        with served(own, tmp_path, lambda: PlaneSweepMap(own)) as life:
            yield life
    else:
        yield lambda: make_reconstructor(own)


@pytest.fixture
def reconstructor(make: Make) -> Reconstructor:
    return make()


def fly(reconstructor: Reconstructor, flight: Sequence[Keyframe]) -> list[Outcome]:
    outcomes: list[Outcome] = []
    for start in range(0, len(flight), 2):
        outcomes += reconstructor.add(flight[start : start + 2])
    return [*outcomes, *reconstructor.flush()]


def assert_sound(mesh: Mesh) -> None:
    assert [array.dtype.name for array in (mesh.vertices, mesh.faces, mesh.colors)] == ["float32", "int32", "uint8"]
    assert mesh.vertices.shape[1] == mesh.faces.shape[1] == mesh.colors.shape[1] == 3
    assert len(mesh.colors) == len(mesh.vertices)
    assert np.isfinite(mesh.vertices).all()
    assert mesh.faces.size == 0 or (mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices))


def contents(mesh: Mesh) -> tuple[bytes, bytes, bytes]:
    return mesh.vertices.tobytes(), mesh.faces.tobytes(), mesh.colors.tobytes()


def blurred(sharp: Keyframe) -> Keyframe:
    """Motion blur along the image's rows, a seventh of its width."""
    image = np.mean([np.roll(sharp.image, shift, axis=1) for shift in range(23)], axis=0).astype(np.uint8)
    return replace(sharp, image=image)


def test_a_new_reconstructor_has_an_empty_mesh_and_nothing_to_flush(reconstructor: Reconstructor) -> None:
    assert_sound(reconstructor.mesh())
    assert reconstructor.mesh().faces.size == 0
    assert reconstructor.add([]) == ()
    assert reconstructor.flush() == ()
    assert reconstructor.statistics().received == 0


def test_every_keyframe_is_decided_exactly_once(reconstructor: Reconstructor, flight: list[Keyframe]) -> None:
    outcomes = fly(reconstructor, flight)
    decided = [(outcome.drone, outcome.sequence) for outcome in outcomes if outcome.state != "waiting"]
    assert sorted(decided) == sorted((one.drone, one.sequence) for one in flight)
    statistics = reconstructor.statistics()
    assert statistics.received == len(flight)
    assert statistics.waiting == 0
    assert statistics.fused + sum(statistics.refused.values()) == len(flight)


def test_each_given_keyframe_gets_an_outcome_at_once(reconstructor: Reconstructor, flight: list[Keyframe]) -> None:
    for one in flight[:6]:
        outcome = reconstructor.add([one])[0]
        assert (outcome.drone, outcome.sequence) == (one.drone, one.sequence)


def test_bad_images_are_survived(reconstructor: Reconstructor, flight: list[Keyframe]) -> None:
    first = flight[0]
    tiny = Intrinsics.from_field_of_view(8, 6, 1.287)
    bad = [
        replace(first, image=np.zeros_like(first.image)),
        replace(first, sequence=1, tick=1, image=np.full_like(first.image, 255)),
        replace(blurred(first), sequence=2, tick=2),
        replace(first, sequence=3, tick=3),
        replace(first, sequence=4, tick=4),
        replace(first, sequence=5, tick=5, image=first.image[:6, :8], intrinsics=tiny, depth=None),
        replace(first, sequence=6, tick=6, image=flight[2].image, position=np.array([90.0, 0.0, 1.0])),
        replace(first, sequence=7, tick=7, image=flight[4].image, rotation=camera_rotation(0.0, -1.5)),
    ]
    fly(reconstructor, bad)
    assert_sound(reconstructor.mesh())


def test_a_mesh_belongs_to_the_caller(reconstructor: Reconstructor, flight: list[Keyframe]) -> None:
    fly(reconstructor, flight)
    before = contents(reconstructor.mesh())
    spoiled = reconstructor.mesh()
    spoiled.vertices[:] = np.nan
    spoiled.faces[:] = -1
    assert contents(reconstructor.mesh()) == before


def test_keyframes_may_follow_a_flush(reconstructor: Reconstructor, flight: list[Keyframe]) -> None:
    fly(reconstructor, flight[:16])
    fly(reconstructor, flight[16:])
    assert reconstructor.statistics().waiting == 0
    assert_sound(reconstructor.mesh())


def restart(old: Reconstructor, make: Make, given: Sequence[Keyframe]) -> Reconstructor:
    """A new reconstructor in the state of one that was given those keyframes."""
    new = make()
    new.restore(old.state(), iter(given[max(0, len(given) - old.lookback) :]))
    return new


@pytest.mark.parametrize("cut", [0, 2, 7, 16, 2 * LEG])
def test_a_restored_reconstructor_has_the_same_mesh_and_takes_up_where_the_other_was(
    flight: list[Keyframe], make: Make, cut: int
) -> None:
    old = make()
    decided = {
        (outcome.drone, outcome.sequence)
        for start in range(0, cut, 2)
        for outcome in old.add(flight[start : min(start + 2, cut)])
        if outcome.state != "waiting"
    }
    before = contents(old.mesh())
    new = restart(old, make, flight[:cut])
    assert contents(new.mesh()) == before
    assert new.statistics() == old.statistics()

    again = {(one.drone, one.sequence): one for one in fly(new, flight[cut:]) if one.state != "waiting"}
    at_state = {(one.drone, one.sequence) for one in old.add([]) if one.state != "waiting"}  # fused by `state` itself
    assert decided | at_state | set(again) == {(one.drone, one.sequence) for one in flight}
    assert not (decided | at_state) & set(again), "nothing is fused twice"
    assert new.statistics().received == len(flight)
    assert new.statistics().waiting == 0
    assert_sound(new.mesh())


def test_a_state_belongs_to_the_caller(reconstructor: Reconstructor, flight: list[Keyframe]) -> None:
    fly(reconstructor, flight[:16])
    state = reconstructor.state()
    before = {name: array.tobytes() for name, array in state.items()}
    fly(reconstructor, flight[16:])
    assert {name: array.tobytes() for name, array in state.items()} == before


def test_keyframes_given_again_after_a_restart_are_not_taken_twice(
    reconstructor: Reconstructor, backend: str, make: Make, flight: list[Keyframe]
) -> None:
    for start in range(0, 12, 2):
        reconstructor.add(flight[start : start + 2])
    new = restart(reconstructor, make, flight[:12])
    before = contents(new.mesh())
    outcomes = new.add(flight[:12])[:12]
    assert backend in ("none", "external") or {outcome.reason for outcome in outcomes} == {"repeated"}
    assert contents(new.mesh()) == before


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"position": np.array([0.0, np.nan, 1.0])}, "not finite"),
        ({"position": np.zeros(2)}, "shapes"),
        ({"rotation": np.diag([1.0, 1.0, -1.0])}, "right-handed"),
        ({"rotation": 2.0 * np.eye(3)}, "orthonormal"),
        ({"image": np.zeros((90, 90, 3), np.uint8)}, "image"),
        ({"image": np.zeros((90, 160, 3), np.float32)}, "image"),
        ({"depth": np.ones((54, 54), np.float32)}, "not the image's shape"),
        ({"depth": np.ones((54, 96), np.float64)}, "expected float32"),
        ({"depth": np.zeros((0, 0), np.float32)}, "expected float32"),
        ({"depth": np.full((54, 96), np.nan, np.float32)}, "depth is not finite"),
        ({"depth": np.full((54, 96), -1.0, np.float32)}, "negative"),
    ],
)
def test_an_impossible_keyframe_cannot_be_made(
    flight: list[Keyframe], change: dict[str, Floats], complaint: str
) -> None:
    with pytest.raises(ReconstructionError, match=complaint):
        replace(flight[0], **change)  # type: ignore[arg-type]  # wrong on purpose


@mapping
def test_the_map_is_where_the_boxes_and_the_floor_are(make: Make, flight: list[Keyframe]) -> None:
    reconstructor = make()
    fly(reconstructor, flight)
    mesh = reconstructor.mesh()
    assert_sound(mesh)
    assert len(mesh.faces) > 5000
    assert share_right(mesh) > 0.9


@mapping
def test_cameras_of_the_other_handedness_map_nothing(make: Make, flight: list[Keyframe]) -> None:
    """As graphics libraries have them: y up and looking along -z."""
    reconstructor = make()
    fly(reconstructor, [replace(one, rotation=one.rotation @ np.diag([1.0, -1.0, -1.0])) for one in flight])
    assert reconstructor.mesh().faces.size == 0


@mapping
def test_poses_in_another_unit_than_metres_are_survived(make: Make, flight: list[Keyframe]) -> None:
    for factor in (1000.0, 0.001):
        reconstructor = make()
        fly(reconstructor, [replace(one, position=factor * one.position) for one in flight])
        assert_sound(reconstructor.mesh())


@mapping
def test_a_frozen_camera_changes_nothing(make: Make, backend: str, flight: list[Keyframe]) -> None:
    frozen = []
    for place, one in enumerate(flight):
        again = replace(flight[12], tick=one.tick, position=one.position, rotation=one.rotation)
        frozen.append(again if place > 12 and one.drone == flight[12].drone else one)
    reconstructor = make()
    outcomes = fly(reconstructor, frozen)
    assert share_right(reconstructor.mesh()) > 0.9
    assert backend == "external" or sum(outcome.reason == "repeated" for outcome in outcomes) == LEG - 7


@mapping
def test_blurred_and_black_images_do_not_spoil_the_map(make: Make, flight: list[Keyframe]) -> None:
    spoiled = list(flight)
    for place in (4, 9, 14):
        spoiled[place] = blurred(flight[place])
        spoiled[place + 3] = replace(flight[place + 3], image=np.zeros_like(flight[place + 3].image))
    reconstructor = make()
    fly(reconstructor, spoiled)
    mesh = reconstructor.mesh()
    assert len(mesh.faces) > 4000
    assert share_right(mesh) > 0.9


@mapping
def test_keyframes_without_overlap_make_no_map(make: Make, backend: str, flight: list[Keyframe]) -> None:
    apart = [flight[0], replace(flight[-2], tick=900)]
    reconstructor = make()
    outcomes = fly(reconstructor, apart)
    assert reconstructor.mesh().faces.size == 0
    assert backend == "external" or [one.reason for one in outcomes if one.reason] == ["no_overlap"] * 2


@mapping
def test_a_pose_outlier_is_kept_out_of_the_map(make: Make, backend: str, flight: list[Keyframe]) -> None:
    aside = list(flight)
    aside[10] = replace(flight[10], position=flight[10].position + np.array([0.05, 0.1, 0.3]))
    aside[17] = replace(flight[17], rotation=camera_rotation(0.5, 1.0))
    reconstructor = make()
    outcomes = fly(reconstructor, aside)
    assert share_right(reconstructor.mesh()) > 0.88
    refused = {(one.drone, one.sequence) for one in outcomes if one.reason}
    assert backend == "external" or {(one.drone, one.sequence) for one in (flight[10], flight[17])} <= refused


@mapping
def test_keyframes_out_of_order_make_no_wrong_map(make: Make, flight: list[Keyframe]) -> None:
    """Each drone's second of three comes last."""
    order = [place + step for place in range(0, 24, 6) for step in (0, 1, 4, 5, 2, 3)]
    reconstructor = make()
    outcomes = fly(reconstructor, [flight[place] for place in order])
    decided = [(outcome.drone, outcome.sequence) for outcome in outcomes if outcome.state != "waiting"]
    assert sorted(decided) == sorted((flight[place].drone, flight[place].sequence) for place in order)
    assert share_right(reconstructor.mesh()) > 0.88


# What follows holds for the plane sweep alone.


@pytest.fixture(scope="module")
def boxes(flight: list[Keyframe]) -> Mesh:
    reconstructor = make_reconstructor(mission())
    fly(reconstructor, flight)
    return reconstructor.mesh()


def test_the_boxes_and_the_floor_are_found_where_they_are(boxes: Mesh) -> None:
    assert_sound(boxes)
    assert share_right(boxes) > 0.9
    inside = boxes.vertices
    for lower, upper in BOXES:
        middle = [(low + high) / 2 for low, high in zip(lower[:2], upper[:2], strict=True)]
        above = np.abs(inside[:, :2] - middle).max(axis=1) < 0.1
        assert np.median(inside[above, 2]) == pytest.approx(upper[2], abs=0.01)


def test_the_mesh_has_the_colors_of_the_images(boxes: Mesh) -> None:
    shades = boxes.colors.astype(float).mean(axis=0)
    assert shades[1] / shades[0] == pytest.approx(0.8, abs=0.02)
    assert shades[2] / shades[0] == pytest.approx(0.6, abs=0.02)


def test_the_mesh_does_not_depend_on_workers_or_on_when_it_was_asked_for(boxes: Mesh, flight: list[Keyframe]) -> None:
    reconstructor = make_reconstructor(mission(workers=2))
    for start in range(0, len(flight), 2):
        reconstructor.add(flight[start : start + 2])
        if start % 3 == 2:
            reconstructor.mesh()
        if start % 8 == 6:
            reconstructor.state()
    reconstructor.mesh()
    reconstructor.flush()
    assert contents(reconstructor.mesh()) == contents(boxes)


def test_the_map_grows_before_the_flight_ends(flight: list[Keyframe]) -> None:
    reconstructor = make_reconstructor(mission())
    for start in range(0, 20, 2):
        reconstructor.add(flight[start : start + 2])
    assert len(reconstructor.mesh().faces) > 1000


def test_a_map_across_a_restart_is_as_good_as_one_without(boxes: Mesh, flight: list[Keyframe]) -> None:
    old = make_reconstructor(mission())
    for start in range(0, 14, 2):
        old.add(flight[start : start + 2])
    new = restart(old, lambda: make_reconstructor(mission()), flight[:14])
    fly(new, flight[14:])
    found, expected = new.mesh(), boxes
    assert len(found.vertices) == pytest.approx(len(expected.vertices), rel=0.01)
    distances, _ = cKDTree(expected.vertices).query(found.vertices)
    assert np.quantile(distances, 0.95) < 0.005


def test_two_restarts_from_the_same_checkpoint_make_the_same_map(flight: list[Keyframe]) -> None:
    old = make_reconstructor(mission())
    for start in range(0, 14, 2):
        old.add(flight[start : start + 2])
    meshes = []
    for workers in (1, 2):
        new = restart(old, lambda workers=workers: make_reconstructor(mission(workers=workers)), flight[:14])
        fly(new, flight[14:])
        meshes.append(contents(new.mesh()))
    assert meshes[0] == meshes[1]


def test_after_a_restart_without_the_newest_keyframes_the_map_still_grows(flight: list[Keyframe]) -> None:
    old = make_reconstructor(mission())
    for start in range(0, 14, 2):
        old.add(flight[start : start + 2])
    new = make_reconstructor(mission())
    new.restore(old.state(), [])
    assert new.statistics().waiting == 0
    (refused,) = new.add([flight[12]])
    assert refused.reason == "repeated", "what is as old as the newest before the restart"
    fly(new, flight[14:])
    assert len(new.mesh().faces) > len(old.mesh().faces)


def test_a_state_of_another_box_is_refused() -> None:
    larger = mission().model_copy(update={"target": Target(lower_m=(-1, -1, 0), upper_m=(1, 1, 1.8))})
    with pytest.raises(ReconstructionError, match="does not fit"):
        make_reconstructor(larger).restore(make_reconstructor(mission()).state(), [])


def reasons(outcomes: Sequence[Outcome]) -> dict[int, str]:
    return {outcome.sequence: outcome.reason for outcome in outcomes if outcome.reason is not None}


def test_useless_keyframes_are_refused_with_the_reason(flight: list[Keyframe]) -> None:
    one, two, three = flight[0], flight[2], flight[4]
    outcomes = fly(
        make_reconstructor(mission()),
        [
            one,
            replace(one, sequence=1, tick=0, image=two.image),
            replace(one, sequence=2, tick=2, position=one.position + 0.1),
            replace(one, sequence=3, tick=3, image=np.full_like(one.image, 7)),
            replace(blurred(two), sequence=4, tick=4),
            replace(three, sequence=5, tick=5, rotation=camera_rotation(0.0, -1.5)),
            replace(three, sequence=6, tick=6, position=np.array([0.9, 0.9, 1.0])),
        ],
    )
    assert reasons(outcomes) == {
        0: "no_overlap",
        1: "repeated",
        2: "repeated",
        3: "featureless",
        4: "blurred",
        5: "off_target",
        6: "no_overlap",
    }


def test_views_whose_poses_are_wrong_are_kept_out_of_the_map(flight: list[Keyframe]) -> None:
    own = flight[::2]
    swapped = [replace(one, image=own[5 * n % LEG].image) for n, one in enumerate(own)]
    reconstructor = make_reconstructor(mission())
    assert set(reasons(fly(reconstructor, swapped)).values()) == {"no_depth"}
    assert reconstructor.statistics().fused < 3


def misplaced(true: Keyframe, shift_m: float, turn_rad: float, seed: int = 4) -> Keyframe:
    """With a pose that is off by so much, standard deviation of each axis; another for each keyframe."""
    dice = np.random.default_rng([seed, true.drone, true.sequence])
    turn = turn_matrix(dice.normal(0, turn_rad, 3))
    return replace(true, position=true.position + dice.normal(0, shift_m, 3), rotation=turn @ true.rotation)


def share_in_place(mesh: Mesh, expected: Mesh) -> float:
    """Of the vertices, within 1.5 cm of those expected."""
    distances, _ = cKDTree(expected.vertices).query(mesh.vertices)
    return float(np.mean(distances < 0.015)) if len(distances) else 0.0


def test_poses_that_are_a_little_wrong_are_mended(boxes: Mesh, flight: list[Keyframe]) -> None:
    noisy = [misplaced(one, 0.02, np.radians(0.5)) for one in flight]
    meshes = []
    for backend in ("plane_sweep", "plane_sweep" + REFINED):
        reconstructor = make_reconstructor(mission(backend))
        fly(reconstructor, noisy)
        meshes.append(reconstructor.mesh())
    left, mended = meshes
    assert len(mended.faces) > 1.5 * len(left.faces)
    assert share_in_place(mended, boxes) > 0.6 > 3 * share_in_place(left, boxes)


def test_exact_poses_are_left_as_they_are(boxes: Mesh, flight: list[Keyframe]) -> None:
    reconstructor = make_reconstructor(mission("plane_sweep" + REFINED))
    fly(reconstructor, flight)
    mesh = reconstructor.mesh()
    assert len(mesh.faces) == pytest.approx(len(boxes.faces), rel=0.03)
    assert share_in_place(mesh, boxes) > 0.95


def test_a_pose_that_cannot_be_mended_is_refused_and_does_not_spoil_the_map(
    boxes: Mesh, flight: list[Keyframe]
) -> None:
    wrong = {12, 17, 22}
    moved = np.array([0.25, -0.2, 0.1])
    spoiled = [replace(one, position=one.position + moved) if n in wrong else one for n, one in enumerate(flight)]
    reconstructor = make_reconstructor(mission("plane_sweep" + REFINED))
    refused = {(one.drone, one.sequence) for one in fly(reconstructor, spoiled) if one.reason == "pose"}
    assert refused == {(flight[n].drone, flight[n].sequence) for n in wrong}
    assert reconstructor.statistics().refused == {"pose": len(wrong)}
    assert share_in_place(reconstructor.mesh(), boxes) > 0.93


def test_refined_poses_are_there_again_after_a_restart(flight: list[Keyframe]) -> None:
    noisy = [misplaced(one, 0.02, np.radians(0.5)) for one in flight]
    backend = "plane_sweep" + REFINED
    old = make_reconstructor(mission(backend))
    for start in range(0, 16, 2):
        old.add(noisy[start : start + 2])
    new = restart(old, lambda: make_reconstructor(mission(backend)), noisy[:16])
    assert {name: array.tobytes() for name, array in new.state().items() if name.startswith("pose_")} == {
        name: array.tobytes() for name, array in old.state().items() if name.startswith("pose_")
    }
    for reconstructor in (old, new):
        fly(reconstructor, noisy[16:])
    assert len(new.mesh().vertices) == pytest.approx(len(old.mesh().vertices), rel=0.02)
    assert share_in_place(new.mesh(), old.mesh()) > 0.9


def test_a_hovering_drone_does_not_keep_its_keyframes_waiting(flight: list[Keyframe]) -> None:
    reconstructor = make_reconstructor(mission())
    for one in flight[:8]:
        reconstructor.add([one])
    assert reconstructor.statistics().fused == 0
    late = replace(flight[-1], tick=10_000)
    reconstructor.add([late])
    outcomes = reconstructor.add([])
    assert {outcome.sequence for outcome in outcomes} == {0, 1, 2, 3}


def test_what_was_seen_free_is_free(reconstructor: Reconstructor, flight: list[Keyframe], backend: str) -> None:
    fly(reconstructor, flight)
    grid = ObstacleGrid.of(mission(backend))
    free = reconstructor.free_cells(grid)
    if backend in ("external", "learned", "none"):
        assert np.array_equal(free, grid.vouched), "who has not measured what is free says nothing"
        return
    low = grid.origin + grid.cell_m * np.argwhere(free)
    high = low + grid.cell_m
    assert len(low) > 300
    assert low[:, 2].min() > -NEAR_M
    for lower, upper in BOXES:
        within = (high > np.array(lower) + NEAR_M) & (low < np.array(upper) - NEAR_M)
        assert not within.all(axis=1).any()
