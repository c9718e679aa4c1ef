"""A flight under the filter of system calls that the systemd units ask for: what they forbid, nobody needs."""

from __future__ import annotations

import ctypes.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from deploy.local import environment
from faults.sandbox import calls_of
from protocol.guard import ROOT

UNIT = ROOT / "deploy" / "systemd" / "covrecon-ground@.service"
"""All have the same filter (`tests/unit/test_deploy_files.py`)."""
LIMIT_S = 100.0
MISSION = """
name = "confined"
duration_s = 5
[simulation]
scene = ""
[reconstruction]
backend = "none"
[feedback]
method = "none"
"""
FORBIDDEN = """
import os, socket
for call in (
    lambda: os.sched_setaffinity(0, os.sched_getaffinity(0)),
    lambda: os.chroot("/"),
    lambda: socket.socket(socket.AF_PACKET, socket.SOCK_RAW),
):
    try:
        call()
    except PermissionError:
        print("refused")
socket.socket(socket.AF_INET).close()
"""

pytestmark = [
    pytest.mark.light,
    pytest.mark.skipif(
        shutil.which("systemd-analyze") is None or ctypes.util.find_library("seccomp") is None,
        reason="systemd-analyze and libseccomp are needed (Debian: systemd)",
    ),
]


def confined(*command: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "faults.sandbox", UNIT, *command],
        env=environment(os.environ) | {"PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}"},
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )


def test_a_flight_needs_no_call_that_the_units_forbid(tmp_path: Path) -> None:
    mission = tmp_path / "mission.toml"
    mission.write_text(MISSION)
    covrecon = Path(sys.executable).with_name("covrecon")
    flown = confined(covrecon, "run", mission, "--drones", "2", "--headless", "--out", tmp_path / "runs")

    assert flown.returncode == 0, flown.stdout + flown.stderr
    assert (tmp_path / "runs" / "latest" / "report.html").exists()


def test_what_the_units_forbid_is_refused() -> None:
    told = confined(sys.executable, "-c", FORBIDDEN)

    assert told.stdout.split() == ["refused"] * 3, told.stderr
    assert told.returncode == 0


def test_the_filter_is_what_systemd_makes_of_it() -> None:
    calls = calls_of(UNIT)

    assert {"read", "sendmsg", "mmap", "futex", "epoll_wait"} <= calls
    assert not calls & {"mount", "reboot", "chown", "bpf", "ptrace", "sched_setaffinity"}
