"""What the replay page shows when, and that it stays small however long the flight was."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from ground_station.report import replay_scene as scenes
from ground_station.report.coarse_mesh import coarse_mesh
from ground_station.report.replay_scene import Scene, replay_scene
from ground_station.report.run_data import FieldMoment, History, MapMoment, Mesh, Run, flight_of
from ground_station.trajectories import Trajectories
from protocol.mission import Drone, Mission

MISSION = Mission(name="m", drones=(Drone(id=3, start=(0, 0, 2, 0, 1.3)), Drone(id=7, start=(2, 0, 2, 0, 1.3))))
RED, BLUE = (200, 0, 0), (0, 0, 200)


def run(ticks: int, silent: range = range(0), **parts: object) -> Run:
    """Drone 3 flies along x, 1 cm a tick; drone 7 stands, and is not heard in ``silent``."""
    trajectories = Trajectories([3, 7])
    for tick in range(ticks):
        poses = {3: (0.01 * tick, 0.0, 2.0, 0.0, 1.3), 7: (2.0, 1.0, 1.0, 0.5, 1.0)}
        if tick in silent:
            del poses[7]
        trajectories.add(tick, tick / 20, poses, {})
    bare = Run(MISSION, {}, flight_of(trajectories.arrays()), None, None)
    return replace(bare, **parts)


def scene_of(found: Run) -> Scene:
    scene = replay_scene(found)
    assert scene is not None
    return scene


def wall(side: int) -> Mesh:
    """A vertical square of 2 x ``side`` x ``side`` triangles, red below and blue above 0.5 m."""
    grid = np.linspace(0, 1, side + 1, dtype=np.float32)
    y, z = (axis.ravel() for axis in np.meshgrid(grid, grid, indexing="ij"))
    corner = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).ravel()
    right, up = side + 1, 1
    faces = np.concatenate([
        np.stack([corner, corner + right, corner + right + up], axis=1),
        np.stack([corner, corner + right + up, corner + up], axis=1),
    ]).astype(np.int32)  # fmt: skip
    return Mesh(np.stack([5 + 0 * y, y, z], axis=1), faces, np.where(z[:, None] < 0.5, RED, BLUE).astype(np.uint8))


def test_no_flight_is_no_scene() -> None:
    assert replay_scene(replace(run(3), flight=None)) is None
    assert replay_scene(run(0)) is None


def test_trails_follow_each_other_without_gaps_up_to_the_end() -> None:
    scene = scene_of(run(1234))
    pieces = [frame.trails[0] for frame in scene.frames if frame.trails]
    assert len(pieces) <= scenes.TRAIL_PIECES + 1
    for before, after in itertools.pairwise(pieces):
        np.testing.assert_array_equal(before[-1], after[0])
    np.testing.assert_allclose(pieces[0][0], [0, 0, 2])
    np.testing.assert_allclose(pieces[-1][-1], [12.33, 0, 2], rtol=1e-6)


@pytest.mark.parametrize("ticks", [1, 2, 60, 40_000])
def test_frames_are_few_and_span_the_flight(ticks: int) -> None:
    scene = scene_of(run(ticks))
    assert len(scene.frames) == min(ticks, scenes.FRAMES)
    assert (scene.frames[0].time_s, scene.frames[-1].time_s) == pytest.approx((0, (ticks - 1) / 20))
    played_s = (scene.frames[-1].time_s - scene.frames[0].time_s) / scene.speed
    assert played_s <= scenes.LONGEST_PLAY_S + 1e-9
    assert scene.speed == 1 or played_s == pytest.approx(scenes.LONGEST_PLAY_S)


def test_a_silent_drone_stays_where_it_was_and_an_unheard_one_nowhere() -> None:
    late = scene_of(run(10, silent=range(4)))
    assert np.isnan([frame.poses[1] for frame in late.frames[:4]]).all()
    lost = scene_of(run(10, silent=range(6, 10)))
    np.testing.assert_array_equal(lost.frames[9].poses[1], [2.0, 1.0, 1.0, 0.5, 1.0])
    assert scene_of(run(3, silent=range(3))).frames[2].trails[1].shape == (0, 3)


def test_maps_come_when_they_came_and_the_final_one_at_the_end() -> None:
    maps = [MapMoment(time_s, wall(2)) for time_s in (0.12, 0.3)]
    scene = scene_of(run(11, mesh=wall(3), history=History(maps=maps)))
    assert {frame.time_s: len(frame.map.mesh.faces) for frame in scene.frames if frame.map} == pytest.approx(
        {0.15: 8, 0.3: 8, 0.5: 18}
    )


def test_without_a_recording_the_final_map_is_there_from_the_start() -> None:
    scene = scene_of(run(11, mesh=wall(3)))
    assert [frame.time_s for frame in scene.frames if frame.map] == [0.0]


def test_only_important_positions_become_points_and_of_a_large_field_a_part() -> None:
    positions = np.arange(3 * 3 * scenes.POINTS, dtype=np.float32).reshape(-1, 3)
    importance = np.where(np.arange(len(positions)) < 600, 0.5, 0.01).astype(np.float32)
    scene = scene_of(run(11, history=History(fields=[FieldMoment(0.2, positions, importance)])))
    (field,) = [frame.field for frame in scene.frames if frame.field]
    np.testing.assert_array_equal(field.positions, positions[:600:3])


def test_the_caption_says_the_time_and_the_importance_of_the_row_before() -> None:
    curves = {"time_s": np.array([0.0, 1.0]), "importance": np.array([1.0, 0.25])}
    frames = scene_of(run(30, curves=curves)).frames
    assert (frames[19].caption, frames[20].caption) == ("1 s   J 1.00", "1 s   J 0.25")
    assert scene_of(run(30)).frames[0].caption == "0 s"


def test_a_mesh_that_is_small_enough_stays_as_it_is() -> None:
    mesh = wall(4)
    assert coarse_mesh(mesh, 32) is mesh


def test_a_coarse_mesh_lies_where_the_fine_one_lay_in_the_same_colours() -> None:
    mesh = wall(100)
    coarse = coarse_mesh(mesh, 2_000)
    assert 1_000 < len(coarse.faces) <= 2_000
    np.testing.assert_allclose(coarse.vertices[:, 0], 5, rtol=1e-6)
    np.testing.assert_allclose(coarse.vertices.min(axis=0)[1:], 0, atol=0.05)
    np.testing.assert_allclose(coarse.vertices.max(axis=0)[1:], 1, atol=0.05)
    away = np.abs(coarse.vertices[:, 2] - 0.5) > 0.05
    expected = np.where(coarse.vertices[:, 2:] < 0.5, RED, BLUE)
    np.testing.assert_array_equal(coarse.colours[away], expected[away])
    a, b, c = (coarse.vertices[coarse.faces[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    assert (normals[:, 0] > 0).all()  # all on the side that they were on
    assert 0.85 < np.linalg.norm(normals, axis=1).sum() / 2 <= 1.0


def test_the_same_mesh_is_made_coarse_in_the_same_way() -> None:
    first, second = (coarse_mesh(wall(40), 500) for _ in range(2))
    for part in ("vertices", "faces", "colours"):
        assert getattr(first, part).tobytes() == getattr(second, part).tobytes()


def test_faces_that_fall_on_each_other_are_kept_once() -> None:
    doubled = wall(30)
    doubled = Mesh(doubled.vertices, np.concatenate([doubled.faces] * 2), doubled.colours)
    assert len(coarse_mesh(doubled, 400).faces) == len(np.unique(np.sort(coarse_mesh(doubled, 400).faces), axis=0))
