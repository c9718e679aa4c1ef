"""Flights of real processes with a real map, and their replays in the process that people start."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from faults.processes import LOCKSTEP_MISSION, write_scene

pytestmark = pytest.mark.processes

COVRECON = Path(sys.executable).with_name("covrecon")
LIMIT_S = 150
"""For one command on a busy machine, compiling included."""


@dataclass(frozen=True)
class Flight:
    folder: Path
    jumps: int


def covrecon(*arguments: str | Path) -> tuple[int, str]:
    done = subprocess.run([COVRECON, *arguments], capture_output=True, text=True, timeout=LIMIT_S, check=False)
    return done.returncode, done.stdout + done.stderr


def fly(folder: Path, speed: str) -> Flight:
    mission = folder / "small.toml"
    mission.write_text(LOCKSTEP_MISSION.format(scene=write_scene(folder)))
    code, output = covrecon("run", mission, "--headless", "--speed", speed, "--out", folder / "runs")
    assert code == 0, output
    run = (folder / "runs" / "latest").resolve()
    return Flight(run, json.loads((run / "summary.json").read_text())["jumps"])


@pytest.fixture(scope="module")
def lockstep(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    return fly(tmp_path_factory.mktemp("lockstep"), "max")


def test_a_flight_in_lockstep_is_replayed_to_the_last_bit(lockstep: Flight, tmp_path: Path) -> None:
    code, output = covrecon("replay", lockstep.folder, "--out", tmp_path / "again")

    assert code == 0, output
    assert f"same phi, same map, {lockstep.jumps} jumps equal" in output
    assert lockstep.jumps > 0
    for name in ("metrics.csv", "mesh.ply", "mission.json"):
        assert (tmp_path / "again" / name).read_bytes() == (lockstep.folder / name).read_bytes(), name


def test_without_a_map_the_replay_never_jumps(lockstep: Flight) -> None:
    recording = lockstep.folder / "recording.mcap"

    code, output = covrecon("replay", recording, "--set", "reconstruction.backend=none")

    folder = lockstep.folder / "recording-replay-1"
    summary = json.loads((folder / "summary.json").read_text())
    assert code == 0, output
    assert summary["jumps"] == 0
    assert summary["mesh_sha256"] is None
    assert summary["J"] < json.loads((lockstep.folder / "summary.json").read_text())["J"]
    assert f"report: {folder / 'report.html'}" in output


def test_a_flight_is_replayed_with_m3c2_feedback_and_that_again_gives_the_same_phi(
    lockstep: Flight, tmp_path: Path
) -> None:
    summaries = []
    for out in (tmp_path / "once", tmp_path / "again"):
        code, output = covrecon("replay", lockstep.folder, "--set", "feedback.method=m3c2", "--out", out)
        assert code == 0, output
        summaries.append(json.loads((out / "summary.json").read_text()))

    flown = json.loads((lockstep.folder / "summary.json").read_text())
    assert summaries[0]["phi_sha256"] == summaries[1]["phi_sha256"] != flown["phi_sha256"]
    assert summaries[0]["mesh_sha256"] == flown["mesh_sha256"]
    assert summaries[0]["jumps"] > 0


def test_a_flight_in_real_time_is_replayed_to_the_last_bit(tmp_path: Path) -> None:
    flight = fly(tmp_path, "1")

    code, output = covrecon("replay", flight.folder)

    assert code == 0, output
    assert f"same phi, same map, {flight.jumps} jumps equal" in output
    assert flight.jumps > 0
