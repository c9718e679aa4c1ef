"""From a recording on disk to what is said about its replay; the recordings are written by the ground station's own
recorder, of a flight without images."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from ground_station.reconstruction.reconstructor import Mesh
from ground_station.recording.recorder import Recorder
from ground_station.recording.repair import repair
from ground_station.replay.__main__ import BAD_INPUT, DIFFERENT, SAME, main
from ground_station.results import Metrics, Summary
from protocol import messages
from protocol.field import VirtualField
from protocol.importance import ImportanceField
from protocol.map_settings import Feedback, Reconstruction
from protocol.mission import Drone, Mission, Target
from protocol.replication import Integrated

MISSION = Mission(
    name="recorded",
    target=Target(lower_m=(-1, -1, 0), upper_m=(1, 1, 1), cell_m=0.5, cell_rad=0.8),
    feedback=Feedback(threshold=1.0),
    reconstruction=Reconstruction(backend="none"),
    drones=(Drone(id=1, start=(0, 0, 2, 0, 1.4)), Drone(id=3, start=(1.5, 0, 2, 0, 1.4))),
)
TICKS = 100
LOOK, JUMP = 40, 60
NOON = datetime(2026, 1, 1, 12, tzinfo=UTC)


def record(path: Path, *, jump: bool = False, first: int = 0, resumed: bool = False, finish: bool = True) -> Path:
    """A flight over ``TICKS`` ticks; its ``jump`` is one that no map led to."""
    field = ImportanceField(VirtualField.of(MISSION.target), MISSION.sensing)
    with Recorder(path, MISSION, lossless=True, resumed=resumed, wall_clock=lambda: NOON) as recorder:
        for tick in range(first, TICKS):
            poses = np.array([[0.1 * math.sin(0.05 * tick), 0.02 * tick, 1.4, 0.3, 1.4], [1.1, 0.0, 1.5, 0.0, 1.5]])
            field.advance(poses, MISSION.tick_s)
            recorder.integrated(Integrated(tick, [1, 3], poses, None))
            if tick == LOOK:
                recorder.looked(tick, field.importance)
            if jump and tick == LOOK:
                increments = np.full(field.phi.shape[0], 0.25, np.float32)
                recorder.jumped(tick, messages.Jump(epoch=5, sequence=0, tick=JUMP, increments=increments), tick)
        if finish:
            final = Metrics((TICKS - 1) / 20, TICKS - 1, field.importance, None, int(jump), 0)
            recorder.finished(summary(final, field.sha256), Mesh.empty())
    return path


def summary(final: Metrics, phi_sha256: str) -> Summary:
    return Summary(
        mission=MISSION.name,
        seed=MISSION.seed,
        drones=len(MISSION.drones),
        exit_reason="as planned",
        final=final,
        floor_baseline=None,
        min_separation_m=1.0,
        fallbacks={},
        wall_time_s=1.0,
        phi_sha256=phi_sha256,
        mesh_sha256=None,
        versions={},
    )


@pytest.fixture
def say(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, list[str]]]:
    """The replay's exit code, and what it said, errors first."""

    def replay(*arguments: str | Path) -> tuple[int, list[str]]:
        code = main([str(argument) for argument in arguments])
        out, error = capsys.readouterr()
        return code, (error + out).splitlines()

    return replay


def test_an_equal_replay_says_so(tmp_path: Path, say: Callable[..., tuple[int, list[str]]]) -> None:
    assert say(record(tmp_path / "a.mcap")) == (SAME, ["same phi, same map, 0 jumps equal"])
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


def test_a_replay_that_differs_says_where_it_began(tmp_path: Path, say: Callable[..., tuple[int, list[str]]]) -> None:
    code, lines = say(record(tmp_path / "a.mcap", jump=True))

    assert code == DIFFERENT
    difference = f"tick {JUMP}: jump 0, from the map of tick {LOOK}, does not come about in the replay"
    assert lines == [f"not the same, first of all: {difference}"]


def test_other_settings_leave_a_runs_folder_to_compare(
    tmp_path: Path, say: Callable[..., tuple[int, list[str]]]
) -> None:
    out = tmp_path / "other"
    code, lines = say(record(tmp_path / "a.mcap"), "--set", "sensing.decay_per_s=0.5", "--out", out)

    found = json.loads((out / "summary.json").read_bytes())
    with (out / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert code == SAME
    assert [line.split()[:2] for line in lines[1:3]] == [["J", "0.752"], ["f_score_visible", "-"]]
    assert lines[1].split()[2] == f"{found['J']:.3f}"
    assert lines[-1] == f"report: {out / 'report.html'}"
    assert (out / "report.html").exists()
    assert [float(row["time_s"]) for row in rows] == [0, 1, 2, 3, 4, 4.95]
    assert found["exit_reason"] == "replay of a.mcap"
    assert Mission.model_validate_json((out / "mission.json").read_bytes()).sensing.decay_per_s == 0.5


def test_a_flight_that_was_cut_short_is_replayed_once_it_is_repaired(
    tmp_path: Path, say: Callable[..., tuple[int, list[str]]]
) -> None:
    whole = record(tmp_path / "a.mcap", finish=False).read_bytes()
    torn, mended = tmp_path / "torn.mcap", tmp_path / "mended.mcap"
    torn.write_bytes(whole[:-20])

    code, lines = say(torn)
    assert code == DIFFERENT
    assert "covrecon recording repair" in lines[0]

    repair(torn, mended)
    assert say(mended) == (SAME, ["the same for 5.0 s, 0 jumps equal; there the recording ends"])


def test_a_recording_from_the_middle_of_a_flight_is_refused(
    tmp_path: Path, say: Callable[..., tuple[int, list[str]]]
) -> None:
    code, lines = say(record(tmp_path / "a.mcap", first=30, resumed=True))

    assert code == DIFFERENT
    assert lines[0].startswith(f"{tmp_path / 'a.mcap'}: begins at tick 30, when the ground station was started again")


def test_a_setting_that_cannot_be_is_bad_input(tmp_path: Path, say: Callable[..., tuple[int, list[str]]]) -> None:
    assert say(record(tmp_path / "a.mcap"), "--set", "feedback.kapa=1") == (
        BAD_INPUT,
        ["feedback.kapa: unknown key, did you mean kappa?"],
    )


def test_a_folder_that_holds_a_flight_is_left_alone(tmp_path: Path, say: Callable[..., tuple[int, list[str]]]) -> None:
    recording, out = record(tmp_path / "a.mcap"), tmp_path / "out"
    assert say(recording, "--out", out)[0] == SAME
    before = (out / "metrics.csv").read_bytes()

    code, lines = say(recording, "--out", out)

    assert code == BAD_INPUT
    assert "holds a flight already" in lines[0]
    assert (out / "metrics.csv").read_bytes() == before
