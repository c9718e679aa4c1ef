from __future__ import annotations

import json
from pathlib import Path

import pytest

from deploy.outcome import describe, read_outcome
from faults.told import told
from ground_station.evaluation import Score, Scores
from ground_station.results import Metrics, RunFolder
from protocol.errors import ProcessError
from protocol.guard import ROOT
from protocol.mission_file import load_mission, mission_to_json

DEMO = load_mission(ROOT / "missions" / "demo.toml")


def scores(f: float) -> Scores:
    return Scores(Score(f, f, f), Score(f, f, f), Score(f, f, f))


def test_what_the_ground_station_writes_is_told_beside_the_baseline(tmp_path: Path) -> None:
    (tmp_path / "mission.json").write_text(mission_to_json(DEMO))
    run = RunFolder(tmp_path, DEMO)
    final = Metrics(time_s=123.4, tick=2468, importance=0.249, scores=scores(0.6), jumps=12, keyframes=500)
    run.finish(final, floor_baseline=scores(0.2), phi_sha256="", wall_time_s=60.0, exit_reason="J fell below 0.25")
    run.close()
    (tmp_path / "report.html").touch()

    assert list(describe(read_outcome(tmp_path), tmp_path)) == [
        "J 0.249 after 123 s of flight: J fell below 0.25",
        "F-score at 5 cm, visible: 0.600 (a bare floor: 0.200)",
        "F-score at 5 cm, exposed: 0.600 (a bare floor: 0.200)",
        "F-score at 5 cm, objects: 0.600 (a bare floor: 0.200)",
        "500 keyframes, 12 jumps, 0 ticks of braking",
        f"report: {tmp_path}/report.html",
    ]


def test_a_run_without_a_truth_has_no_scores_to_tell(tmp_path: Path) -> None:
    run = RunFolder(tmp_path, DEMO)
    run.record_tick(0, 0.0, {1: (0, 0, 2, 0, 1), 2: (1.25, 0, 2, 0, 1)}, {2: told(outcome="infeasible")})
    final = Metrics(time_s=1.0, tick=20, importance=0.9, scores=None, jumps=0, keyframes=0)
    run.finish(final, floor_baseline=None, phi_sha256="", wall_time_s=1.0, exit_reason="time is up")
    run.close()

    lines = list(describe(read_outcome(tmp_path), tmp_path))

    assert lines[1:3] == ["smallest separation 1.250 m", "0 keyframes, 0 jumps, 1 ticks of braking"]
    assert lines[-1].endswith("(it holds no report.html)")


@pytest.mark.parametrize("content", ["", "[]", json.dumps({"J": 0.3})])
def test_an_unreadable_summary_is_an_error_that_names_it(tmp_path: Path, content: str) -> None:
    (tmp_path / "summary.json").write_text(content)

    with pytest.raises(ProcessError, match=rf"{tmp_path}/summary\.json: "):
        read_outcome(tmp_path)
