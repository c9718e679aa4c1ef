"""A study of real flights in a small scene: interrupted, gone on with, and the same wherever it is flown."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

from faults.processes import processes_of, write_scene
from protocol.guard import ROOT

MISSION = """
name = "small"
[target]
lower_m = [-1.0, -1.0, 0.0]
upper_m = [1.0, 1.0, 0.6]
[flight]
lower_m = [-2.0, -2.0, 0.5]
upper_m = [2.0, 2.0, 2.5]
[sensing]
decay_per_s = 6.0
[controller]
coverage_rate_per_s = 0.2
[camera]
width_px = 160
height_px = 90
[reconstruction]
sweep_width_px = 80
depth_planes = 32
[simulation]
scene = "{scene}"
[[drones]]
id = 1
start = [-0.8, 0.0, 1.4, 0.0, 1.3]
"""
DURATION_S = 6
LIMIT_S = 100
"""For one study on a busy machine; a hang is what it bounds."""
Bench = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture(scope="module")
def mission(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scene")
    path = folder / "small.toml"
    path.write_text(MISSION.format(scene=write_scene(folder)))
    return path


@pytest.fixture
def bench(tmp_path: Path, mission: Path) -> Iterator[Bench]:
    """Starts ``covrecon bench``; at the end none of its processes may be left."""
    started: list[subprocess.Popen[str]] = []

    def start(*options: str, out: str = "study") -> subprocess.Popen[str]:
        command = [sys.executable, "-P", "-c", "from deploy.cli import main; main()", "bench", *options]
        command += ["--mission", str(mission), "--duration", str(DURATION_S), "--out", str(tmp_path / out)]
        run = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env={"PYTHONPATH": str(ROOT)}
        )
        started.append(run)
        return run

    yield start
    for run in started:
        if run.poll() is None:
            run.kill()
        run.communicate()
    wait_for(lambda: not processes_of(tmp_path), "processes left behind")


def wait_for(condition: Callable[[], object], what: str) -> None:
    deadline = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.05)


def finish(run: subprocess.Popen[str]) -> tuple[int, str]:
    output, _ = run.communicate(timeout=LIMIT_S)
    return run.returncode, output


def flown(study: Path) -> dict[str, Path]:
    """By method."""
    return {path.name.partition("-")[0]: path for path in (study / "flights").glob("[!.]*")}


def flies(study: Path, method: str) -> bool:
    return any(path.stat().st_size > 200 for path in study.glob(f"flying/{method}-*/runs/latest/metrics.csv"))


def hashes(flight: Path) -> tuple[str, str]:
    summary = json.loads((flight / "summary.json").read_text())
    return summary["phi_sha256"], summary["mesh_sha256"]


pytestmark = pytest.mark.timeout(300)  # several studies in one test; each is bounded by itself
FEEDBACK = ("feedback", "--seeds", "1", "--scenes", "table.obj", "--jobs", "1")


def test_a_study_that_was_interrupted_goes_on_with_the_flights_that_are_left(tmp_path: Path, bench: Bench) -> None:
    study = tmp_path / "study"
    run = bench(*FEEDBACK)
    wait_for(lambda: "none" in flown(study) and flies(study, "grid"), "the second flight never took off")
    run.send_signal(signal.SIGINT)
    code, output = finish(run)
    assert code == 128 + signal.SIGINT, output
    assert not processes_of(tmp_path)
    assert set(flown(study)) == {"none"}
    first = {path: path.stat().st_mtime_ns for path in flown(study)["none"].iterdir()}

    code, output = finish(bench(*FEEDBACK))
    assert code == 0, output
    assert "1 of 2 flights to fly" in output
    assert set(flown(study)) == {"none", "grid"}
    assert {path: path.stat().st_mtime_ns for path in flown(study)["none"].iterdir()} == first
    summary = json.loads((flown(study)["grid"] / "summary.json").read_text())
    assert summary["jumps"] > 0
    assert summary["feedback_update_s"] > 0
    assert not (study / "flying").exists()
    text = (study / "evaluation.md").read_text()
    assert "2 of 2 flights" in text
    assert "| table | end, 6 s | 1 |" in text
    assert (study / "gain.svg").stat().st_size > 0

    code, output = finish(bench(*FEEDBACK, "--report-only"))
    assert code == 0, output
    assert (study / "evaluation.md").read_text() == text


def test_a_study_that_is_killed_leaves_no_process_and_no_half_flight(tmp_path: Path, bench: Bench) -> None:
    study = tmp_path / "study"
    run = bench(*FEEDBACK)
    wait_for(lambda: flies(study, "none"), "the first flight never took off")
    run.kill()
    wait_for(lambda: not processes_of(tmp_path), "processes outlived the study")
    assert not flown(study)


def test_a_flight_that_fails_is_told_with_its_last_words(tmp_path: Path, bench: Bench, mission: Path) -> None:
    mission.with_name("broken.glb").write_bytes(b"this is no mesh")
    options = ("paper", "--methods", "none", "--seeds", "1", "--set", "simulation.scene=broken.glb")
    code, output = finish(bench(*options))
    assert code == 1
    assert output.count("failed: ended with exit code") == 1
    assert "broken.glb" in output
    assert not flown(tmp_path / "study")


@pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed (extra cluster)")
def test_flights_on_a_ray_cluster_come_to_the_same_as_on_this_machine(tmp_path: Path, bench: Bench) -> None:
    found = []
    for executor in ("local", "ray"):
        code, output = finish(bench(*FEEDBACK, "--executor", executor, out=executor))
        assert code == 0, output
        found.append({method: hashes(path) for method, path in flown(tmp_path / executor).items()})
    assert len(found[0]) == 2
    assert found[0] == found[1]


def test_without_ray_it_is_told_how_to_come_by_it(bench: Bench) -> None:
    if find_spec("ray") is not None:
        pytest.skip("Ray is installed")
    code, output = finish(bench(*FEEDBACK, "--executor", "ray"))
    assert code == 1
    assert "Ray is not installed: pip install 'coverage-recon[cluster]'" in output
