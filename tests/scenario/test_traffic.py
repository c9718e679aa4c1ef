"""A drone's bandwidth, counted at its network interface, is what `covrecon traffic` plans, within a fifth."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from deploy.local import environment
from faults.hosts import reason_against_hosts
from faults.traffic_flight import DRONES, SEEING
from protocol.guard import ROOT

FLIGHT_S = 150.0
"""For the whole command; it takes half a minute."""
WITHIN = 0.2


@pytest.mark.light
@pytest.mark.timeout(180)  # the flight has its own bounds
@pytest.mark.parametrize("states", ["direct", "gathered"])
def test_a_drone_s_bandwidth_is_as_planned_within_a_fifth(states: str, tmp_path: Path) -> None:
    reason = reason_against_hosts()
    if reason is not None:
        pytest.skip(reason)
    paths = {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}

    # In a process of its own: it moves to the ground's namespace, for good.
    done = subprocess.run(
        [sys.executable, "-m", "faults.traffic_flight", "--out", str(tmp_path), "--states", states],
        env=environment(os.environ) | paths,
        capture_output=True,
        text=True,
        check=False,
        timeout=FLIGHT_S,
    )

    sys.stdout.write(done.stdout)  # the figures, for who asks for them: pytest -s
    assert done.returncode == 0, done.stdout + done.stderr
    figures = json.loads((tmp_path / "figures.json").read_text())
    for drone in DRONES:
        for direction in ("up", "down"):
            told = figures[f"drone-{drone}"][direction]
            assert told["counted_kB_per_s"] == pytest.approx(told["planned_kB_per_s"], rel=WITHIN), (drone, direction)
    ups = {drone: figures[f"drone-{drone}"]["up"]["counted_kB_per_s"] for drone in DRONES}
    assert ups[SEEING] > 2 * max(up for drone, up in ups.items() if drone != SEEING), "its images were counted"
