"""Whole missions over MAVLink through ``covrecon run``: PX4-like vehicles, MAVSDK, agents, map, every one a process."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from faults.processes import processes_of, write_scene
from faults.px4_flight import free_ports
from ground_station.keyframe_log import KeyframeLog

pytestmark = pytest.mark.processes
COVRECON = Path(sys.executable).with_name("covrecon")
LIMIT_S = 110
"""For one flight on a busy machine, with taking off, coming home and landing."""
Fly = Callable[..., "subprocess.Popen[str]"]

MISSION = """
name = "small-px4"
duration_s = 60.0
stop_below = 0.25
[vehicles]
kind = "px4"
origin = [47.397742, 8.545594, 488.0]
[target]
lower_m = [-0.6, -0.6, 0.0]
upper_m = [0.6, 0.6, 0.6]
[flight]
lower_m = [-3.0, -3.0, 0.5]
upper_m = [3.0, 3.0, 2.5]
position_error_m = 0.08
[controller]
coverage_rate_per_s = 0.2
[camera]
width_px = 160
height_px = 90
[reconstruction]
sweep_width_px = 80
depth_planes = 32
[recording]
report = false
[simulation]
scene = "{scene}"
[[drones]]
id = 1
start = [-0.9, 0.0, 1.4, 0.0, 1.3]
[[drones]]
id = 3
start = [0.9, 0.0, 1.4, 3.0, 1.3]
"""


@pytest.fixture
def fly(tmp_path: Path) -> Iterator[Fly]:
    started: list[subprocess.Popen[str]] = []
    path = tmp_path / "small.toml"

    def start(*options: str, more: str = "") -> subprocess.Popen[str]:
        path.write_text(MISSION.format(scene=write_scene(tmp_path)) + more)
        url = f"udpin://127.0.0.1:{free_ports(2)}"
        command = [COVRECON, "run", path, "--headless", "--vehicles", "px4-endpoint", "--px4-url", url, *options]
        run = subprocess.Popen(
            [*command, "--out", tmp_path / "runs"],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=os.environ | {"TMPDIR": str(tmp_path)},  # where ports and systems are locked: others fly as well
        )
        started.append(run)
        return run

    yield start
    for run in started:
        if run.poll() is None:
            run.kill()
        run.communicate()


def wait_for(condition: Callable[[], object], what: str, limit_s: float = LIMIT_S) -> None:
    deadline = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.05)


def log_of(folder: Path, name: str) -> str:
    path = folder / "logs" / f"{name}.log"
    return path.read_text() if path.exists() else ""


def judge(folder: Path) -> dict[str, dict[str, float]]:
    """Nobody came too near to another, and all stand on the ground at home; the endpoint's figures by drone."""
    truth = json.loads((folder / "vehicles.json").read_text())
    assert truth["min_separation_m"] >= 1.0
    with np.load(folder / "vehicles.npz") as file:
        last = dict(zip(file["ids"].tolist(), file["poses"][-1], strict=True))
        highest = file["poses"][:, :, 2].max(axis=0)
    assert (highest > 1.0).all(), "both flew"
    for drone, home in ((1, (-0.9, 0.0)), (3, (0.9, 0.0))):
        assert abs(last[drone][2]) < 0.15, "on the ground"
        assert np.linalg.norm(last[drone][:2] - home) < 0.6
    figures: dict[str, dict[str, float]] = truth["vehicles"]
    return figures


def test_two_take_off_cover_map_and_come_home(tmp_path: Path, fly: Fly) -> None:
    run = fly()
    output, _ = run.communicate(timeout=LIMIT_S)
    folder = tmp_path / "runs" / "latest"
    assert run.returncode == 0, output + log_of(folder, "drone-1")

    summary = json.loads((folder / "summary.json").read_text())
    assert summary["J"] < 0.25
    assert summary["keyframes"] > 10
    assert summary["f_score_visible"] > 0.4
    assert summary["min_separation_m"] >= 1.0
    figures = judge(folder)
    assert set(figures) == {"1", "3"}
    with np.load(folder / "trajectories.npz") as flown:
        ages = flown["telemetry_age_s"]
        assert np.nanpercentile(ages, 50) < 0.1


def test_drones_fly_on_while_nobody_beats_the_time(tmp_path: Path, fly: Fly) -> None:
    run = fly("--restart", "1")
    folder = tmp_path / "runs" / "latest"
    wait_for(lambda: "ours" in log_of(folder, "drone-1") or _is_flying(folder), "never took off")
    (observer,) = processes_of(tmp_path, "sim_bridge")
    os.kill(observer, signal.SIGKILL)
    output, _ = run.communicate(timeout=LIMIT_S)

    assert run.returncode == 0, output
    assert "sim was killed by SIGKILL; started again" in output
    assert "joining at tick" in log_of(folder, "sim")
    judge(folder)


def test_an_interrupt_lands_everybody_where_he_is(tmp_path: Path, fly: Fly) -> None:
    """Drone 3 has a camera of its own: what it saw is in the log of keyframes, beside the simulator's for drone 1."""
    film(tmp_path / "seen.avi")
    run = fly(more='camera = "seen.avi"\n')
    folder = tmp_path / "runs" / "latest"
    wait_for(lambda: photographers(folder) == {1: 160, 3: 160}, "no keyframes of both")
    run.send_signal(signal.SIGINT)
    output, _ = run.communicate(timeout=LIMIT_S)

    assert run.returncode == 128 + signal.SIGINT, output
    for drone in (1, 3):
        assert "the control task ends: told to land" in log_of(folder, f"drone-{drone}")
    assert "left to itself" not in log_of(folder, "drone-1")
    with np.load(folder / "vehicles.npz") as file:
        heights = file["poses"][:, :, 2]
    assert (heights[-1] < heights[-60:].max(axis=0) - 0.2).all(), "both came down"


def film(path: Path) -> None:
    """A minute of pictures of twice the mission's size."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 20.0, (320, 180))
    dice = np.random.default_rng(3)
    for _ in range(20 * 60):
        writer.write(cv2.resize(dice.integers(0, 255, (9, 16, 3), dtype=np.uint8), (320, 180)))
    writer.release()


def photographers(folder: Path) -> dict[int, int]:
    """Width of the images by drone, of those that arrived so far."""
    path = folder / "keyframes"
    if not path.exists():
        return {}
    copy = folder / "keyframes.read"
    copy.write_bytes(path.read_bytes())  # the ground station goes on writing
    with KeyframeLog(copy) as log:
        return {keyframe.drone: keyframe.width for _, keyframe in log.read(0, log.end)}


def _is_flying(folder: Path) -> bool:
    metrics = folder / "metrics.csv"
    return metrics.exists() and any(float(line.split(",")[2]) < 1 for line in metrics.read_text().splitlines()[1:])
