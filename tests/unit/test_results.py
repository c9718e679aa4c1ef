"""The run folder: what is written can be read back, whenever the writer dies."""

from __future__ import annotations

import csv
import json
import math
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import trimesh

from faults.disk import FullDisk, dies, in_child
from faults.told import told
from ground_station.evaluation import Score, Scores
from ground_station.mesh_files import mesh_sha256
from ground_station.pose_errors import PoseErrorFigures
from ground_station.results import Metrics, RunFolder, versions
from protocol.errors import MissionError, StorageError
from protocol.mission import Drone, Flight, Mission
from protocol.obstacle_settings import Obstacles

MISSION = Mission(
    name="pair",
    seed=7,
    drones=(Drone(id=1, start=(0.0, 1.0, 2.0, 0.0, 1.4)), Drone(id=4, start=(0.0, -1.0, 2.0, 0.0, 1.4))),
)
SCORES = Scores(visible=Score.of(0.9, 0.8), exposed=Score.of(0.9, 0.7), objects=Score.of(0.85, 0.6))
FLOOR = Scores(visible=Score.of(1.0, 0.5), exposed=Score.of(1.0, 0.4), objects=Score.of(0.0, 0.0))
VERTICES = np.array([[0, 0, 0], [1, 0, 0], [1, 2, 0], [0, 2, 3]], np.float32)
FACES = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
COLOURS = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [128, 128, 128]], np.uint8)


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[RunFolder]:
    run = RunFolder(tmp_path / "run", MISSION)
    yield run
    run.close()


def metrics(tick: int, scores: Scores | None = SCORES) -> Metrics:
    return Metrics(time_s=tick / 20, tick=tick, importance=0.4321, scores=scores, jumps=3, keyframes=42)


def fly(run: RunFolder, first: int, last: int) -> None:
    """Two drones that come nearer by 1 cm a tick; drone 4 falls silent at tick 7 and brakes at every fourth."""
    for tick in range(first, last):
        poses = {1: (0.0, 0.0, 2.0, 0.1, 1.2), 4: (3.0 - 0.01 * tick, 0.0, 2.0, 0.2, 1.3)}
        if tick == 7:
            del poses[4]
        states = {
            1: told(solve_s=0.001, slack=0.0),
            4: told(solve_s=0.002, slack=0.5, outcome="infeasible" if tick % 4 == 0 else "solved"),
        }
        run.record_tick(tick, tick / 20, poses, states)


def finish(run: RunFolder, tick: int = 10) -> dict[str, object]:
    run.finish(
        metrics(tick), floor_baseline=FLOOR, phi_sha256="f" * 64, wall_time_s=2.5, exit_reason="duration",
        feedback_update_s=0.0123, unlocated=5, contacts={1: 0, 4: 2},
        pose_errors=PoseErrorFigures(rms_m=0.02, max_m=0.05, final_m=0.01, yaw_rms_rad=0.003, beyond=0.001),
    )  # fmt: skip
    content: dict[str, object] = json.loads((run.path / "summary.json").read_text())
    return content


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_metrics_rows_can_be_read_while_the_run_goes_on(folder: RunFolder) -> None:
    fly(folder, 0, 5)
    folder.record_metrics(metrics(5))
    (row,) = rows(folder.path / "metrics.csv")
    assert list(row) == [
        "time_s", "tick", "importance", "f_score_visible", "f_score_exposed", "f_score_objects", "precision", "recall",
        "jumps", "keyframes", "min_separation_m", "separation_1_m", "separation_4_m",
    ]  # fmt: skip
    assert {key: float(value) for key, value in row.items()} == pytest.approx(
        {
            "time_s": 0.25, "tick": 5, "importance": 0.4321, "f_score_visible": SCORES.visible.f,
            "f_score_exposed": SCORES.exposed.f, "f_score_objects": SCORES.objects.f, "precision": 0.9, "recall": 0.8,
            "jumps": 3, "keyframes": 42, "min_separation_m": 2.96, "separation_1_m": 2.96, "separation_4_m": 2.96,
        },
        abs=1e-6,
    )  # fmt: skip


def test_a_row_shows_the_nearest_approach_since_the_row_before(folder: RunFolder) -> None:
    for tick, distance in enumerate([5.0, 1.2, 5.0]):
        folder.record_tick(tick, tick / 20, {1: (0, 0, 1, 0, 1), 4: (distance, 0, 1, 0, 1)}, {})
    folder.record_metrics(metrics(3))
    folder.record_tick(3, 0.15, {1: (0, 0, 1, 0, 1), 4: (4.0, 0, 1, 0, 1)}, {})
    folder.record_metrics(metrics(4))
    assert [row["min_separation_m"] for row in rows(folder.path / "metrics.csv")] == ["1.2", "4.0"]
    assert finish(folder)["min_separation_m"] == 1.2


def test_separation_is_judged_by_the_truth_where_it_is_told(folder: RunFolder) -> None:
    believed = {1: (0.0, 0.0, 2.0, 0.1, 1.2), 4: (3.0, 0.0, 2.0, 0.2, 1.3)}
    folder.record_tick(0, 0.0, believed, {}, {1: (0.5, 0.0, 2.0, 0.1, 1.2), 4: (3.0, 0.0, 2.0, 0.2, 1.3)})
    assert folder.min_separation_m == 2.5


def test_what_a_run_does_not_have_stays_empty(tmp_path: Path) -> None:
    alone = MISSION.model_copy(update={"drones": MISSION.drones[:1]})
    run = RunFolder(tmp_path, alone)
    run.record_tick(0, 0.0, {1: (0, 0, 1, 0, 1)}, {})
    run.record_metrics(metrics(1, scores=None))
    run.finish(metrics(1, scores=None), floor_baseline=None, phi_sha256="0", wall_time_s=1.0, exit_reason="stopped")
    run.close()
    (row,) = rows(tmp_path / "metrics.csv")
    assert [key for key, value in row.items() if not value] == [
        "f_score_visible", "f_score_exposed", "f_score_objects", "precision", "recall",
        "min_separation_m", "separation_1_m",
    ]  # fmt: skip
    summary = json.loads((tmp_path / "summary.json").read_text())
    empty = [key for key, value in summary.items() if value is None]
    assert {"f_score_objects", "min_separation_m", "mesh_sha256"} <= set(empty)
    assert set(summary["floor_baseline"].values()) == {None}
    assert not (tmp_path / "mesh.ply").exists()


def test_the_summary_holds_every_figure_by_which_runs_are_compared(folder: RunFolder) -> None:
    fly(folder, 0, 10)
    folder.write_mesh(VERTICES, FACES, COLOURS)
    summary = finish(folder)
    baseline = summary.pop("floor_baseline")
    assert summary.pop("versions") == versions()
    assert summary == {
        "mission": "pair", "seed": 7, "drones": 2, "exit_reason": "duration", "J": 0.4321,
        "f_score_visible": pytest.approx(2 * 0.72 / 1.7), "f_score_exposed": pytest.approx(2 * 0.63 / 1.6),
        "f_score_objects": pytest.approx(2 * 0.51 / 1.45, abs=1e-6),
        "precision_visible": 0.9, "precision_exposed": 0.9, "precision_objects": 0.85,
        "recall_visible": 0.8, "recall_exposed": 0.7, "recall_objects": 0.6,
        "min_separation_m": 2.91, "jumps": 3, "keyframes": 42, "fallbacks": {"1": 0, "4": 3}, "ticks": 10,
        "sim_time_s": 0.5, "wall_time_s": 2.5, "feedback_update_s": 0.0123,
        "pose_error_rms_m": 0.02, "pose_error_max_m": 0.05, "pose_error_final_m": 0.01, "pose_error_yaw_rms_rad": 0.003,
        "pose_error_beyond": 0.001, "keyframes_unlocated": 5, "contacts": {"1": 0, "4": 2},
        "min_obstacle_margin_m": None, "fallbacks_among_obstacles": None,
        "phi_sha256": "f" * 64, "mesh_sha256": mesh_sha256(VERTICES, FACES),
    }  # fmt: skip
    assert isinstance(baseline, dict)
    assert baseline["f_score_visible"] == pytest.approx(2 / 3, abs=1e-6)


def test_the_summary_says_how_near_drones_came_to_obstacles_and_how_often_they_braked_among_them(
    tmp_path: Path,
) -> None:
    mission = MISSION.model_copy(update={"flight": Flight(obstacles=Obstacles(enabled=True))})
    run = RunFolder(tmp_path, mission)
    for tick, margin in enumerate((0.5, -0.0625)):
        states = {1: told(obstacle_m=margin, outcome="infeasible"), 4: told(outcome="infeasible")}
        run.record_tick(tick, tick / 20, {1: (0, 0, 1, 0, 1), 4: (3, 0, 1, 0, 1)}, states)
    summary = finish(run)
    run.close()
    assert summary["min_obstacle_margin_m"] == -0.0625
    assert summary["fallbacks_among_obstacles"] == {"1": 2, "4": 0}


def test_trajectories_and_solver_outcomes_are_read_back(folder: RunFolder) -> None:
    fly(folder, 0, 10)
    folder.checkpoint()
    with np.load(folder.path / "trajectories.npz") as flown:
        assert flown["drones"].tolist() == [1, 4]
        assert flown["tick"].tolist() == list(range(10))
        np.testing.assert_allclose(flown["time_s"], np.arange(10) / 20)
        assert flown["poses"].shape == (10, 2, 5)
        np.testing.assert_allclose(flown["poses"][3, 1], [2.97, 0, 2, 0.2, 1.3])
        assert np.isnan(flown["poses"][7, 1]).all()
        assert np.isnan(flown["poses"]).sum() == 5
        np.testing.assert_allclose(flown["solve_time_s"], [[0.001, 0.002]] * 10)
        np.testing.assert_allclose(flown["slack"], [[0.0, 0.5]] * 10)
        assert np.argwhere(flown["fallback"] != "").tolist() == [[0, 1], [4, 1], [8, 1]]
        assert flown["fallback"][4, 1] == "infeasible"


def test_a_checkpoint_holds_what_was_flown_until_then(folder: RunFolder) -> None:
    fly(folder, 0, 6)
    folder.checkpoint()
    fly(folder, 6, 10)
    with np.load(folder.path / "trajectories.npz") as flown:
        assert flown["tick"].tolist() == list(range(6))


def test_a_folder_that_holds_a_flight_is_refused_and_left_as_it_is(folder: RunFolder) -> None:
    fly(folder, 0, 6)
    folder.record_metrics(metrics(6))
    folder.close()
    before = (folder.path / "metrics.csv").read_bytes()
    with pytest.raises(MissionError, match=r"metrics\.csv: this folder holds a flight already"):
        RunFolder(folder.path, MISSION)
    assert (folder.path / "metrics.csv").read_bytes() == before


def test_a_folder_in_which_nothing_was_flown_yet_can_be_used(folder: RunFolder) -> None:
    folder.close()
    RunFolder(folder.path, MISSION).close()
    assert rows(folder.path / "metrics.csv") == []


def test_equal_runs_leave_equal_bytes(tmp_path: Path) -> None:
    written = []
    for name in ("one", "other"):
        run = RunFolder(tmp_path / name, MISSION)
        fly(run, 0, 30)
        run.record_metrics(metrics(30))
        run.write_mesh(VERTICES, FACES, COLOURS)
        finish(run)
        run.close()
        written.append({path.name: path.read_bytes() for path in sorted(run.path.iterdir())})
    assert list(written[0]) == [
        "mesh.glb", "mesh.ply", "metrics.csv", "mission.json", "summary.json", "trajectories.npz",
    ]  # fmt: skip
    assert written[0] == written[1]


def test_a_folder_of_another_mission_is_refused(folder: RunFolder) -> None:
    with pytest.raises(MissionError, match=r"mission\.json: this run folder belongs to another mission"):
        RunFolder(folder.path, MISSION.model_copy(update={"seed": 8}))


def test_the_effective_mission_is_kept(folder: RunFolder) -> None:
    assert Mission.model_validate_json((folder.path / "mission.json").read_text()) == MISSION


def test_the_ply_keeps_positions_faces_and_colours(folder: RunFolder) -> None:
    folder.write_mesh(VERTICES, FACES, COLOURS)
    mesh = trimesh.load_mesh(folder.path / "mesh.ply", process=False)
    np.testing.assert_array_equal(mesh.vertices, VERTICES)
    np.testing.assert_array_equal(mesh.faces, FACES)
    np.testing.assert_array_equal(mesh.visual.vertex_colors[:, :3], COLOURS)  # type: ignore[union-attr]


def test_the_glb_has_y_up_linear_colours_and_a_matt_material(folder: RunFolder) -> None:
    folder.write_mesh(VERTICES, FACES, COLOURS)
    content = (folder.path / "mesh.glb").read_bytes()
    length = int.from_bytes(content[12:16], "little")
    tree = json.loads(content[20 : 20 + length])
    (primitive,) = tree["meshes"][0]["primitives"]
    assert tree["materials"][primitive["material"]]["pbrMetallicRoughness"]["metallicFactor"] == 0
    assert "COLOR_0" in primitive["attributes"]
    (mesh,) = trimesh.load_scene(folder.path / "mesh.glb").geometry.values()
    np.testing.assert_allclose(mesh.vertices, np.column_stack([VERTICES[:, 0], VERTICES[:, 2], -VERTICES[:, 1]]))
    np.testing.assert_array_equal(mesh.faces, FACES)
    # sRGB 128 is 21.6 % of the light (IEC 61966-2-1).
    assert tree["accessors"][primitive["attributes"]["COLOR_0"]]["max"][:3] == [255, 255, 255]
    stored = np.frombuffer(content, np.uint8, offset=len(content) - 16).reshape(4, 4)
    np.testing.assert_array_equal(stored[:, :3], [[255, 0, 0], [0, 255, 0], [0, 0, 255], [55, 55, 55]])


def test_an_empty_mesh_leaves_no_file(folder: RunFolder) -> None:
    folder.write_mesh(VERTICES[:0], FACES[:0], COLOURS[:0])
    assert not list(folder.path.glob("mesh*"))
    assert finish(folder)["mesh_sha256"] is None


def test_mesh_hashes_depend_on_every_vertex_and_face() -> None:
    expected = mesh_sha256(VERTICES, FACES)
    assert mesh_sha256(VERTICES.astype(">f4"), FACES.astype(np.int64)) == expected
    assert mesh_sha256(VERTICES + np.float32(1e-3), FACES) != expected
    assert mesh_sha256(VERTICES, FACES[::-1]) != expected


def test_versions_name_python_and_what_computes() -> None:
    found = versions()
    assert found["python"] == ".".join(map(str, sys.version_info[:3]))
    assert {"numpy", "numba", "osqp", "coverage-recon"} <= set(found)


def test_recording_a_tick_is_cheap(folder: RunFolder) -> None:
    began = time.process_time()
    fly(folder, 0, 2000)
    assert (time.process_time() - began) / 2000 < 0.001  # 200 ticks a second must cost little; measured 0.00002 s


def test_rows_survive_a_kill(tmp_path: Path) -> None:
    script = f"""
import os, signal
from pathlib import Path
from ground_station.results import Metrics, RunFolder
from protocol.mission import Mission
run = RunFolder(Path({str(tmp_path / "run")!r}), Mission.model_validate_json({MISSION.model_dump_json()!r}))
for tick in range(100):
    run.record_metrics(Metrics(tick / 20, tick, 0.5, None, 0, tick))
os.kill(os.getpid(), signal.SIGKILL)
"""
    root = Path(__file__).parents[2]
    killed = subprocess.run([sys.executable, "-c", script], cwd=root, check=False, timeout=60)
    assert killed.returncode == -signal.SIGKILL
    survived = rows(tmp_path / "run" / "metrics.csv")
    assert [int(row["keyframes"]) for row in survived] == list(range(100))
    assert math.isclose(float(survived[-1]["time_s"]), 99 / 20)


# --- after a crash ---------------------------------------------------------------------------------------------------


def crash(run: RunFolder) -> RunFolder:
    """The folder as the next process opens it: one that wrote a journal and was killed."""
    run.close()
    (run.path / "journal").touch()
    return RunFolder(run.path, MISSION)


def ticks(path: Path) -> list[int]:
    return [int(row["tick"]) for row in rows(path / "metrics.csv")]


def test_after_a_crash_rows_and_trajectories_go_on(folder: RunFolder) -> None:
    fly(folder, 0, 6)
    folder.record_metrics(metrics(5))
    folder.checkpoint()
    fly(folder, 6, 9)
    folder.record_metrics(metrics(8))

    again = crash(folder)
    fly(again, 15, 20)
    again.record_metrics(metrics(20))
    summary = finish(again, 20)
    again.close()

    assert ticks(again.path) == [5, 8, 20]
    with np.load(again.path / "trajectories.npz") as flown:
        assert flown["tick"].tolist() == [*range(6), *range(15, 20)], "what no checkpoint held is a gap"
        assert flown["poses"].shape == (11, 2, 5)
        assert np.isfinite(flown["poses"]).all()
        assert flown["fallback"][4, 1] == "infeasible"
    assert summary["fallbacks"] == {"1": 0, "4": 3}, "in ticks 0, 4 and 16"


@pytest.mark.parametrize("set_aside", [False, True])
def test_the_smallest_separation_outlives_a_crash(folder: RunFolder, set_aside: bool) -> None:
    for tick, distance in enumerate([5.0, 1.2, 5.0]):
        folder.record_tick(tick, tick / 20, {1: (0, 0, 1, 0, 1), 4: (distance, 0, 1, 0, 1)}, {})
    folder.record_metrics(metrics(2))
    again = crash(folder)
    if set_aside:
        (again.path / "journal").rename(again.path / "journal.damaged-1")
        again.close()
        again = RunFolder(again.path, MISSION)
    assert again.min_separation_m == 1.2
    again.record_tick(9, 0.45, {1: (0, 0, 1, 0, 1), 4: (4.0, 0, 1, 0, 1)}, {})
    again.record_metrics(metrics(9))
    assert finish(again)["min_separation_m"] == 1.2
    assert rows(again.path / "metrics.csv")[-1]["min_separation_m"] == "4.0"
    again.close()


def test_a_tick_that_has_a_row_from_before_the_crash_gets_no_second_one(folder: RunFolder) -> None:
    folder.record_metrics(metrics(20))
    again = crash(folder)
    for tick in (19, 20, 21):
        again.record_metrics(metrics(tick))
    again.close()
    assert ticks(again.path) == [20, 21]


def test_a_row_torn_at_any_byte_is_written_over_after_the_crash(folder: RunFolder) -> None:
    for tick in (5, 6):
        folder.record_metrics(metrics(tick))
    path = folder.path / "metrics.csv"
    whole = path.read_bytes()
    header = whole.index(b"\n") + 1
    (folder.path / "journal").touch()
    folder.close()
    for size in range(len(whole)):
        path.write_bytes(whole[:size])
        again = RunFolder(folder.path, MISSION)
        again.record_metrics(metrics(7))
        again.close()
        kept = [5, 6][: whole[header:size].count(b"\n")]
        assert ticks(folder.path) == [*kept, 7]


def test_a_damaged_record_is_set_aside_and_the_flight_goes_on(
    folder: RunFolder, caplog: pytest.LogCaptureFixture
) -> None:
    fly(folder, 0, 6)
    folder.record_metrics(metrics(5))
    folder.checkpoint()
    damaged = {}
    for name in ("metrics.csv", "trajectories.npz"):
        content = bytearray((folder.path / name).read_bytes())
        content[5 if name == "metrics.csv" else content.index(b"poses.npy") + 100] ^= 1
        (folder.path / name).write_bytes(content)
        damaged[f"{name}.damaged-1"] = bytes(content)

    again = crash(folder)
    fly(again, 6, 8)
    again.record_metrics(metrics(8))
    again.checkpoint()
    again.close()

    assert {name: (folder.path / name).read_bytes() for name in damaged} == damaged
    assert [entry.levelname for entry in caplog.records] == ["ERROR", "ERROR"]
    assert ticks(folder.path) == [8]
    with np.load(folder.path / "trajectories.npz") as flown:
        assert flown["tick"].tolist() == [6, 7]


def test_trajectories_with_any_byte_changed_never_keep_the_ground_station_from_starting(folder: RunFolder) -> None:
    fly(folder, 0, 3)
    folder.record_metrics(metrics(2))
    folder.checkpoint()
    crash(folder).close()
    path = folder.path / "trajectories.npz"
    whole = path.read_bytes()
    for place in range(0, len(whole), 7):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0x55]) + whole[place + 1 :])
        again = RunFolder(folder.path, MISSION)
        fly(again, 3, 4)
        again.checkpoint()
        again.close()
        with np.load(path) as flown:
            assert flown["tick"].tolist() in ([0, 1, 2, 3], [3])


def test_a_finished_flight_is_not_gone_on_with(folder: RunFolder) -> None:
    fly(folder, 0, 6)
    folder.record_metrics(metrics(6))
    finish(folder)
    with pytest.raises(MissionError, match="holds a flight already"):
        crash(folder)


def test_a_process_that_dies_anywhere_leaves_a_folder_that_can_be_gone_on_with(tmp_path: Path) -> None:
    def record(path: Path) -> None:
        run = RunFolder(path, MISSION)
        for tick in (1, 2):
            fly(run, tick, tick + 1)
            run.record_metrics(metrics(tick))
            run.checkpoint()

    step, recorded = 0, []
    while True:
        path = tmp_path / str(step)
        path.mkdir()
        (path / "journal").touch()
        died = dies(lambda path=path: record(path), step)  # type: ignore[misc]
        again = RunFolder(path, MISSION)
        found = ticks(path)
        assert found == [1, 2][: len(found)]
        again.checkpoint()
        again.close()
        with np.load(path / "trajectories.npz") as flown:
            kept = flown["tick"].tolist()
        assert kept == [1, 2][: len(kept)]
        recorded.append((len(found), len(kept)))
        if not died:
            break
        step += 1
    assert recorded == sorted(recorded)
    assert set(recorded) == {(0, 0), (1, 0), (1, 1), (2, 1), (2, 2)}


# --- a disk that refuses ---------------------------------------------------------------------------------------------


def test_rows_that_a_full_disk_refused_are_written_once_there_is_room(
    folder: RunFolder, caplog: pytest.LogCaptureFixture
) -> None:
    folder.record_metrics(metrics(1))
    disk = folder._metrics._file._file
    folder._metrics._file._file = FullDisk(disk, 30)  # type: ignore[assignment]
    for tick in range(2, 12):
        folder.record_metrics(metrics(tick))
    assert folder.refused_writes == 10
    assert ticks(folder.path)[:1] == [1]
    folder._metrics._file._file = disk
    folder.record_metrics(metrics(12))
    assert ticks(folder.path) == list(range(1, 13))
    assert [entry.levelname for entry in caplog.records] == ["ERROR", "WARNING"]


def test_a_checkpoint_that_the_disk_refused_is_made_up_for_by_the_next(folder: RunFolder) -> None:
    fly(folder, 0, 3)
    folder.checkpoint()
    whole = (folder.path / "trajectories.npz").read_bytes()

    def refused() -> None:
        fly(folder, 3, 6)
        folder.checkpoint()
        assert folder.refused_writes == 1

    assert in_child(refused, largest_file=100) == 0
    assert (folder.path / "trajectories.npz").read_bytes() == whole
    assert not list(folder.path.glob(".*draft"))
    fly(folder, 3, 6)
    folder.checkpoint()
    with np.load(folder.path / "trajectories.npz") as flown:
        assert flown["tick"].tolist() == list(range(6))


def test_results_that_the_disk_refuses_at_the_end_are_an_error_that_names_the_file(folder: RunFolder) -> None:
    fly(folder, 0, 3)

    def end() -> None:
        with pytest.raises(StorageError, match=r"mesh\.ply: File too large"):
            folder.write_mesh(VERTICES, FACES, COLOURS)
        with pytest.raises(StorageError, match="File too large"):
            finish(folder)
        for tick in range(200):
            folder.record_metrics(metrics(tick))
        assert folder.refused_writes > 0
        (folder.path / "trajectories.npz").unlink(missing_ok=True)

    assert in_child(end, largest_file=300) == 0
    assert not (folder.path / "summary.json").exists()
    finish(folder)


def test_a_folder_that_cannot_be_made_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match="Not a directory"):
        RunFolder(tmp_path / "file" / "run", MISSION)


def test_a_checkpoint_may_be_written_while_ticks_are_recorded(folder: RunFolder) -> None:
    fly(folder, 0, 1)
    with ThreadPoolExecutor(1) as other:
        for start in range(1, 2001, 200):
            writing = other.submit(folder.checkpoint)
            fly(folder, start, start + 200)
            writing.result()
    folder.checkpoint()
    with np.load(folder.path / "trajectories.npz") as flown:
        assert flown["tick"].tolist() == list(range(2001))
