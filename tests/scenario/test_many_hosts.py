"""A fleet over links of 5 Mbit/s and 30 ms, each drone on a host of its own: one is cut off and back, one is lost."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from deploy.local import environment
from faults.hosts import reason_against_hosts
from faults.many_hosts import CUT, J_END, LOST
from protocol.guard import ROOT

FLIGHT_S = 200.0
"""For the whole command; it takes a minute."""
SILENCE_KB_PER_S = 2.0
"""What the kernel may still try on a dead link."""
JITTER_S = 0.002
"""What passing packets on in user space may add to a link's delay, 99th percentile."""


@pytest.mark.processes
@pytest.mark.timeout(240)  # the flight has its own bounds
def test_a_fleet_outlives_a_link_that_is_cut_and_a_computer_that_is_lost(tmp_path: Path) -> None:
    reason = reason_against_hosts()
    if reason is not None:
        pytest.skip(reason)
    paths = {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}

    # In a process of its own: it moves to the ground's namespace, for good.
    done = subprocess.run(
        [sys.executable, "-m", "faults.many_hosts", "--out", str(tmp_path)],
        env=environment(os.environ) | paths,
        capture_output=True,
        text=True,
        check=False,
        timeout=FLIGHT_S,
    )

    sys.stdout.write(done.stdout)  # the figures, for who asks for them: pytest -s
    assert done.returncode == 0, done.stdout + done.stderr
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert figures["violations"] == []
    assert figures["J"]["end"] <= J_END < figures["J"]["start"]
    for phase, silent in (("link cut", CUT), ("computer lost", LOST)):
        up, down = figures[phase]["up_and_down_kB_per_s"][f"drone-{silent}"]
        assert max(up, down) < SILENCE_KB_PER_S
    assert figures["radio"]["late_p99_s"] < JITTER_S
    assert (tmp_path / "many-hosts.png").stat().st_size > 0
