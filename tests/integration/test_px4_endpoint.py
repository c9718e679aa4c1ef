"""The endpoint's process: it speaks soon, ends on a signal and leaves the truth behind."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from protocol.mission import Drone, Mission
from protocol.mission_file import mission_to_json
from protocol.process import BAD_INPUT, TERMINATED
from protocol.vehicle_settings import Vehicles

pytestmark = pytest.mark.processes

PATIENCE_S = 30.0


def start(mission: Path, run: Path, *more: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "sim_bridge.px4_endpoint", "--mission", str(mission), "--run", str(run), *more]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_it_speaks_and_ends_on_a_signal_with_the_truth_written(
    tmp_path: Path, root_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    monkeypatch.chdir(root_path)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ground:
        ground.bind(("127.0.0.1", 0))
        ground.settimeout(PATIENCE_S)
        url = f"udpin://127.0.0.1:{ground.getsockname()[1]}"
        drones = (Drone(id=4, start=(0.0, 1.0, 2.0, 0.0, 1.3), url=url),)
        file = tmp_path / "mission.json"
        file.write_text(mission_to_json(Mission(drones=drones, vehicles=Vehicles(kind="px4"))))
        with start(file, tmp_path, "--endpoint", "unused", "--speed", "1") as process:
            assert ground.recv(2048)
            process.send_signal(number)
            _, log = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == TERMINATED, log
    assert "system 4" in log
    with np.load(tmp_path / "vehicles.npz") as truth:
        assert truth["ids"].tolist() == [4]
        assert truth["poses"].shape[1:] == (1, 5)


def test_a_mission_that_is_not_there_is_bad_input(
    tmp_path: Path, root_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(root_path)
    with start(tmp_path / "none.toml", tmp_path) as process:
        _, log = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == BAD_INPUT
    assert "no such file" in log
