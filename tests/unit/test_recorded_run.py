"""The report's data come out the same from a recording as from the run's folder, and from a torn recording what is
left of them."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from faults.recorded import state
from ground_station.evaluation import Score, Scores
from ground_station.mesh_files import glb, ply, read_glb, read_ply
from ground_station.reconstruction.reconstructor import Mesh
from ground_station.recording.recorder import Recorder
from ground_station.recording.states import NewestStates
from ground_station.report.recorded_run import load_recording
from ground_station.report.run_folder import load_run
from ground_station.results import Metrics, RunFolder
from protocol import topics
from protocol.errors import CovreconError, RecordingError
from protocol.messages import DroneState
from protocol.mission import Drone, Mission
from protocol.replication import Integrated

TICKS = 100
SCORES = Scores(visible=Score.of(0.96, 0.8), exposed=Score.of(0.96, 0.7), objects=Score.of(0.9, 0.6))
MAP = Mesh(
    np.array([[0, 0, 0], [1, 0, 0.5], [0, 2, 0.25], [1, 2, 1]], np.float32),
    np.array([[0, 1, 2], [2, 1, 3]], np.int32),
    np.array([[200, 40, 60], [255, 255, 255], [128, 90, 70], [250, 3, 99]], np.uint8),
)
NOON = datetime(2026, 1, 1, 12, tzinfo=UTC)


def fly(folder: Path, drones: int = 2) -> tuple[Path, Path]:
    """A run's folder and its recording."""
    starts = tuple(Drone(id=2 * i + 1, start=(1.5 * i, 0.0, 2.0, 0.0, 1.4)) for i in range(drones))
    mission = Mission(name="recorded", drones=starts)
    ids = [drone.id for drone in mission.drones]
    run, path = RunFolder(folder / "run", mission), folder / "alone.mcap"
    newest: dict[int, DroneState] = {}
    random = np.random.default_rng(1)
    with Recorder(path, mission, lossless=True, wall_clock=lambda: NOON) as recorder:
        for tick in range(TICKS):
            told = {drone: state(drone, tick, random=random) for drone in ids if (tick, drone) != (50, 1)}
            poses = np.array([[math.sin(0.1 * tick) + 1.5 * i, 0.3 * i, 2.0, 0.0, 1.4] for i in range(len(told))])
            for each in told.values():
                recorder.heard(topics.STATE, each, tick)
            recorder.integrated(Integrated(tick, list(told), poses, None))
            run.record_tick(tick, tick * mission.tick_s, dict(zip(told, poses.tolist(), strict=True)), newest | told)
            newest = told
            if tick % 20 == 0 or tick == TICKS - 1:
                metrics = Metrics(tick / 20, tick, 1 - tick / 200, SCORES if tick > 30 else None, tick // 40, tick // 5)
                run.record_metrics(metrics)
                recorder.metrics(metrics)
                recorder.mesh(tick, MAP)
        recorder.metrics(metrics)
        run.write_mesh(MAP.vertices, MAP.faces, MAP.colors)
        summary = run.finish(
            metrics, floor_baseline=None, phi_sha256="9f" * 32, wall_time_s=3.8, exit_reason="duration reached"
        )
        recorder.finished(summary, MAP)
    run.close()
    return run.path, path


def test_a_recording_tells_what_the_runs_folder_tells(tmp_path: Path) -> None:
    folder, recording = fly(tmp_path)

    expected, found = load_run(folder), load_recording(recording)

    assert found.mission == expected.mission
    assert found.summary == expected.summary
    assert list(found.curves) == list(expected.curves)
    for name, curve in expected.curves.items():
        np.testing.assert_allclose(found.curves[name], curve, atol=1e-6, err_msg=name)  # six decimals in the file
    assert found.flight is not None
    for name in found.flight.__slots__:
        np.testing.assert_array_equal(getattr(found.flight, name), getattr(expected.flight, name), err_msg=name)
    assert found.mesh is not None
    np.testing.assert_array_equal(found.mesh.colours, MAP.colors)
    assert [moment.time_s for moment in found.history.maps] == [0.0, 4.95]


def test_a_lone_drone_is_apart_from_nobody(tmp_path: Path) -> None:
    folder, recording = fly(tmp_path, drones=1)

    expected, found = load_run(folder), load_recording(recording)

    assert np.isnan(found.curves["min_separation_m"]).all()
    assert np.isnan(expected.curves["min_separation_m"]).all()


def test_of_a_torn_recording_comes_what_is_left(tmp_path: Path) -> None:
    _, recording = fly(tmp_path)
    content = recording.read_bytes()
    recording.write_bytes(content[: len(content) * 6 // 10])

    run = load_recording(recording)

    assert run.summary is None
    assert run.flight is not None
    assert 0 < len(run.flight.time_s) < TICKS
    assert 0 < len(run.curves["time_s"]) < 6
    assert run.mesh is not None
    np.testing.assert_array_equal(run.mesh.vertices, MAP.vertices)
    assert run.history.notes == ["alone.mcap ends before the flight did."]


def test_what_is_no_recording_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"no recording")

    with pytest.raises(RecordingError, match=r"a\.mcap: not an MCAP file"):
        load_recording(path)


def test_the_newest_state_is_that_of_the_tick_however_states_came() -> None:
    random = np.random.default_rng(1)
    states = {tick: state(1, tick, random=random) for tick in (3, 5, 6, 9)}
    newest = NewestStates({1: iter([states[5], states[3], states[9], states[6]]), 2: iter(())})

    assert newest.at(4) == {}
    assert newest.at(5) == {1: states[5]}
    assert newest.at(8) == {1: states[5]}
    assert newest.at(9) == {1: states[9]}


def test_a_map_comes_back_from_its_files() -> None:
    from_ply, from_glb = (
        read(make(MAP.vertices, MAP.faces, MAP.colors), "map") for make, read in ((ply, read_ply), (glb, read_glb))
    )

    for found in (from_ply, from_glb):
        assert found.vertices.tobytes() == MAP.vertices.tobytes()
        assert found.faces.tobytes() == MAP.faces.tobytes()
    np.testing.assert_array_equal(from_ply.colors, MAP.colors)
    np.testing.assert_allclose(from_glb.colors.astype(int), MAP.colors, atol=4)  # linear light in eight bits


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_a_damaged_map_is_named(share: float) -> None:
    content = glb(MAP.vertices, MAP.faces, MAP.colors)

    with pytest.raises(CovreconError, match="the map: no mesh with triangles and colours"):
        read_glb(content[: int(len(content) * share)], "the map")
