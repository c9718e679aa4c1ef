"""Whole missions through ``covrecon run``: real processes, real zenoh, real images of a small scene."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from faults.processes import processes_of, write_scene

COVRECON = Path(sys.executable).with_name("covrecon")
Write = Callable[..., Path]
Fly = Callable[..., "subprocess.Popen[str]"]
LIMIT_S = 150
"""For one mission on a busy machine, compiling included; a hang is what it bounds."""

MISSION = """
name = "small"
duration_s = {duration}
[target]
lower_m = [-1.0, -1.0, 0.0]
upper_m = [1.0, 1.0, 0.6]
[flight]
lower_m = [-2.0, -2.0, 0.5]
upper_m = [2.0, 2.0, 2.5]
[controller]
coverage_rate_per_s = 0.2
[feedback]
threshold = 1.0
[camera]
width_px = 160
height_px = 90
[reconstruction]
sweep_width_px = 80
depth_planes = 32
[recording]
report = {report}
[simulation]
scene = "{scene}"
[[drones]]
id = 1
start = [-0.8, 0.0, 1.4, 0.0, 1.3]
[[drones]]
id = 3
start = [0.8, 0.0, 1.4, 3.0, 1.3]
"""


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("scene"))


@pytest.fixture
def mission(tmp_path: Path, scene: Path) -> Write:
    def write(duration: float = 10.0, extra: str = "", *, report: bool = False) -> Path:
        path = tmp_path / "small.toml"
        path.write_text(MISSION.format(duration=duration, scene=scene, report=str(report).lower()) + extra)
        return path

    return write


@pytest.fixture
def fly(tmp_path: Path) -> Iterator[Fly]:
    """Starts a run; at the end none of its processes may be left."""
    started: list[subprocess.Popen[str]] = []

    def start(mission: Path, *options: str, out: str = "runs") -> subprocess.Popen[str]:
        command = [COVRECON, "run", mission, "--headless", "--out", tmp_path / out, *options]
        run = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        started.append(run)
        return run

    yield start
    for run in started:
        if run.poll() is None:
            run.kill()
        run.communicate()
    wait_for(lambda: not processes_of(tmp_path), "processes left behind")


def wait_for(condition: Callable[[], object], what: str, limit_s: float = LIMIT_S) -> None:
    deadline = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.05)


def wait_until_flying(folder: Path) -> None:
    metrics = folder / "latest" / "metrics.csv"
    wait_for(lambda: metrics.exists() and len(metrics.read_text().splitlines()) > 2, "never took off")


def finish(run: subprocess.Popen[str]) -> tuple[int, str]:
    output, _ = run.communicate(timeout=LIMIT_S)
    return run.returncode, output


def test_a_mission_maps_its_scene_and_a_second_one_is_equal_to_the_last_bit(
    tmp_path: Path, mission: Write, fly: Fly
) -> None:
    path = mission(duration=14.0, report=True)
    outcomes = []
    for out in ("first", "second"):
        code, output = finish(fly(path, "--speed", "max", out=out))
        assert code == 0, output
        folder = tmp_path / out / "latest"
        for name in ("report.html", "mesh.ply", "mesh.glb", "metrics.csv", "mission.toml", "truth.ply"):
            assert (folder / name).stat().st_size > 0
        with np.load(folder / "trajectories.npz") as recorded:
            outcomes.append((json.loads((folder / "summary.json").read_text()), dict(recorded)))
    (summary, flown), (again, reflown) = outcomes
    assert summary["J"] < 1
    assert summary["jumps"] > 0
    assert summary["keyframes"] > 20
    assert summary["f_score_visible"] > 0.6
    assert summary["f_score_objects"] > 0.4 > summary["floor_baseline"]["f_score_objects"]
    assert summary["min_separation_m"] >= 1.0
    assert summary["exit_reason"] == "duration of 14 s reached"
    for key in ("phi_sha256", "mesh_sha256", "J", "jumps", "keyframes", "f_score_visible"):
        assert summary[key] == again[key], key
    assert flown["poses"].tobytes() == reflown["poses"].tobytes()


OBSTACLES = """
[flight.obstacles]
enabled = true
"""


def test_drones_fly_by_the_map_of_free_cells_and_touch_nothing(tmp_path: Path, mission: Write, fly: Fly) -> None:
    """In lockstep they wait for every map: were there none, each would cost them 20 s."""
    code, output = finish(fly(mission(duration=8.0, extra=OBSTACLES), "--speed", "max"))
    assert code == 0, output
    assert "0 contacts with the scene" in output
    folder = tmp_path / "runs" / "latest"
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["contacts"] == {"1": 0, "3": 0}
    assert summary["J"] < 0.5, "they are not held where they started"
    assert summary["min_separation_m"] >= 1.0


def test_a_mission_flies_in_real_time(tmp_path: Path, mission: Write, fly: Fly) -> None:
    began = time.monotonic()
    code, output = finish(fly(mission(duration=4.0), "--speed", "1"))
    assert code == 0, output
    assert time.monotonic() - began >= 4.0
    summary = json.loads((tmp_path / "runs" / "latest" / "summary.json").read_text())
    assert summary["sim_time_s"] == pytest.approx(4.0, abs=0.2)
    assert summary["J"] < 1


def test_a_killed_agent_is_told_and_the_others_fly_on(tmp_path: Path, mission: Write, fly: Fly) -> None:
    run = fly(mission(duration=20.0), "--speed", "max")
    wait_until_flying(tmp_path / "runs")
    (agent,) = [pid for pid in processes_of(tmp_path, "agents") if _argument(pid, "--drone") == "3"]
    os.kill(agent, signal.SIGKILL)
    code, output = finish(run)
    assert code != 0
    assert "drone-3" in output
    assert "SIGKILL" in output
    folder = tmp_path / "runs" / "latest"
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["exit_reason"] == "duration of 20 s reached"
    assert summary["min_separation_m"] >= 1.0
    assert "drone/3 is gone" in (folder / "logs" / "ground.log").read_text()
    with np.load(folder / "trajectories.npz") as flown:
        heard = ~np.isnan(flown["poses"][:, :, 0])
    assert heard[:, 0].all()
    assert not heard[-1, 1]


@pytest.mark.parametrize("module", ["ground_station", "sim_bridge"])
def test_a_dead_ground_station_or_simulator_ends_the_run_with_an_error(
    tmp_path: Path, mission: Write, fly: Fly, module: str
) -> None:
    run = fly(mission(duration=300.0), "--speed", "max")
    wait_until_flying(tmp_path / "runs")
    (victim,) = processes_of(tmp_path, module)
    os.kill(victim, signal.SIGKILL)
    code, output = finish(run)
    assert code != 0
    assert "SIGKILL" in output


@pytest.mark.parametrize("moment", ["at once", "while starting", "in flight"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_an_interrupted_run_leaves_no_process(
    tmp_path: Path, mission: Write, fly: Fly, moment: str, number: signal.Signals
) -> None:
    run = fly(mission(duration=300.0), "--speed", "max")
    if moment == "while starting":
        wait_for(lambda: processes_of(tmp_path, "agents"), "no agent was started")
    elif moment == "in flight":
        wait_until_flying(tmp_path / "runs")
    run.send_signal(number)
    code, _ = finish(run)
    assert code != 0


@pytest.mark.parametrize(
    ("extra", "said"),
    [
        ('[transport]\nendpoint = "{taken}"\n', "cannot listen"),
        ('[transport]\nendpoint = "nonsense"\n', "nonsense"),
    ],
)
def test_an_endpoint_that_cannot_be_used_ends_the_run_naming_it(
    mission: Write, fly: Fly, extra: str, said: str
) -> None:

    with socket.socket(socket.AF_INET) as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        path = mission(extra=extra.format(taken=endpoint))
        code, output = finish(fly(path))
    assert code != 0
    assert said in output


def test_a_missing_or_broken_scene_ends_the_run_naming_it(tmp_path: Path, mission: Write, fly: Fly) -> None:
    path = mission()
    broken = tmp_path / "broken.glb"
    broken.write_bytes(b"this is no mesh")
    for scene, said in ((tmp_path / "nowhere.glb", "nowhere.glb"), (broken, "broken.glb")):
        text = path.read_text()
        start = text.index("scene = ")
        path.write_text(text[:start] + f'scene = "{scene}"' + text[text.index("\n", start) :])
        code, output = finish(fly(path))
        assert code != 0
        assert said in output


def _argument(pid: int, name: str) -> str:
    arguments = (Path("/proc") / str(pid) / "cmdline").read_bytes().decode().split("\0")
    return arguments[arguments.index(name) + 1] if name in arguments else ""
