"""The process that registers scans: it answers as the same code does here, and outlives nobody."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from agents.localization.registrar import Job, RegistrarProcess, answer
from agents.localization.registration import ScanRegistration
from protocol.localization_settings import Lidar

pytestmark = [pytest.mark.processes, pytest.mark.light]

LIDAR = Lidar()
PATIENCE_S = 60.0
PARENT = """
import time
import numpy as np
from agents.localization.registrar import Job, RegistrarProcess
from protocol.localization_settings import Lidar

if __name__ == "__main__":
    registrar = RegistrarProcess(Lidar())
    registrar.start()
    registrar.submit(Job(None, np.zeros((3, 3), np.int16), np.zeros(4))).result()
    print(registrar._process.pid, flush=True)
    time.sleep(600)
"""


def jobs() -> list[Job]:
    dice = np.random.default_rng(0)
    walls = dice.uniform(-3000, 3000, (2000, 3)) * [1, 1, 0.4]
    walls[np.arange(2000), dice.integers(0, 2, 2000)] = 3000
    shift = np.array([0.05, 0.0, 0.0, 0.0])
    moved = walls - 1000 * shift[:3]
    noise = dice.normal(0, 10, (2, 2000, 3))
    return [
        Job(None, (walls + noise[0]).astype(np.int16), np.zeros(4)),
        Job(np.zeros(4), (moved + noise[1]).astype(np.int16), shift * 0.5),
    ]


def test_it_answers_as_the_same_code_does_here_to_the_last_bit() -> None:
    registrar, here = RegistrarProcess(LIDAR), ScanRegistration(LIDAR)
    registrar.start()
    try:
        for job in jobs():
            expected, found = answer(here, job), registrar.submit(job).result(PATIENCE_S)
            assert found.pose.tobytes() == expected.pose.tobytes()
            assert found.covariance.tobytes() == expected.covariance.tobytes()
            assert found.overlap == expected.overlap
    finally:
        registrar.close()
        registrar.close()
    assert not multiprocessing.active_children()


def test_a_job_for_a_process_that_was_killed_fails_instead_of_waiting() -> None:
    registrar = RegistrarProcess(LIDAR)
    registrar.start()
    try:
        registrar.submit(jobs()[0]).result(PATIENCE_S)
        registrar._process.kill()
        registrar._process.join(PATIENCE_S)
        with pytest.raises((EOFError, OSError)):
            registrar.submit(jobs()[1]).result(PATIENCE_S)
    finally:
        registrar.close()


def test_it_ends_with_an_agent_that_is_killed(tmp_path: Path, root_path: Path) -> None:
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    environment = {**os.environ, "PYTHONPATH": str(root_path)}
    with subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True, env=environment) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        parent.send_signal(signal.SIGKILL)
        parent.wait()
    deadline = time.monotonic() + PATIENCE_S
    while _runs(child):
        assert time.monotonic() < deadline, "the registrar outlived its agent"
        os.sched_yield()


def _runs(process: int) -> bool:
    """Also a zombie has ended."""
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"
