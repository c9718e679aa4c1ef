"""A drone's bandwidth, counted at its network interface, is what `covrecon traffic` plans, within a fifth."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from deploy.local import environment
from faults.hosts import reason_against_hosts
from faults.traffic_flight import DRONES, SEEING
from protocol.guard import ROOT

FLIGHT_S = 150.0
"""For the whole command; it takes half a minute."""
WITHIN = 0.2


def counted(module: str, out: Path, *options: str) -> dict[str, Any]:
    """Figures of a flight, in a process of its own: it moves to the ground's namespace, for good."""
    reason = reason_against_hosts()
    if reason is not None:
        pytest.skip(reason)
    paths = {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}
    done = subprocess.run(
        [sys.executable, "-m", module, "--out", str(out), *options],
        env=environment(os.environ) | paths,
        capture_output=True,
        text=True,
        check=False,
        timeout=FLIGHT_S,
    )
    sys.stdout.write(done.stdout)  # the figures, for who asks for them: pytest -s
    assert done.returncode == 0, done.stdout + done.stderr
    figures: dict[str, Any] = json.loads((out / "figures.json").read_text())
    return figures


def assert_as_planned(told: dict[str, dict[str, float]]) -> None:
    for direction in ("up", "down"):
        expected = pytest.approx(told[direction]["planned_kB_per_s"], rel=WITHIN)
        assert told[direction]["counted_kB_per_s"] == expected, direction


@pytest.mark.light
@pytest.mark.timeout(180)  # the flight has its own bounds
def test_a_drone_s_bandwidth_is_as_planned_within_a_fifth(tmp_path: Path) -> None:
    figures = counted("faults.traffic_flight", tmp_path, "--states", "direct")

    for drone in DRONES:
        assert_as_planned(figures[f"drone-{drone}"])
    ups = {drone: figures[f"drone-{drone}"]["up"]["counted_kB_per_s"] for drone in DRONES}
    assert ups[SEEING] > 2 * max(up for drone, up in ups.items() if drone != SEEING), "its images were counted"


@pytest.mark.light
@pytest.mark.timeout(180)
def test_so_is_that_of_each_of_sixteen_whose_states_are_gathered(tmp_path: Path) -> None:
    assert_as_planned(counted("faults.swarm_traffic", tmp_path, "--drones", "16", "--states", "gathered"))
