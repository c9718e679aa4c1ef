"""Flights in lockstep whose map another process makes, and what becomes of them when it dies."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import trimesh

from faults.processes import LOCKSTEP_MISSION, write_scene

pytestmark = pytest.mark.processes

COVRECON = Path(sys.executable).with_name("covrecon")
LIMIT_S = 150
"""For one flight on a busy machine, compiling included."""
EXAMPLE = "-m deploy.examples.external_map"
MORTAL = """
import os, signal, sys
from deploy.examples.external_map import PlaneSweepMap
from protocol.external_map import run_map_process

class Mortal(PlaneSweepMap):
    asked = 0
    def mesh(self):
        self.asked += 1
        if self.asked > 3:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().mesh()

sys.exit(run_map_process(Mortal))
"""
"""The example, which is killed while its fourth map is waited for."""


@dataclass(frozen=True)
class Flight:
    code: int
    said: str
    folder: Path
    summary: dict[str, Any]

    @property
    def news(self) -> str:
        return (self.folder / "logs" / "ground.log").read_text()


def fly(folder: Path, program: str) -> Flight:
    mission = folder / "small.toml"
    mission.write_text(LOCKSTEP_MISSION.format(scene=write_scene(folder)))
    arguments = ("--headless", "--mapper", f"{sys.executable} {program}", "--out", folder / "runs")
    done = subprocess.run(
        [COVRECON, "run", mission, *arguments], capture_output=True, text=True, timeout=LIMIT_S, check=False
    )
    run = (folder / "runs" / "latest").resolve()
    assert (run / "summary.json").exists(), done.stdout + done.stderr
    return Flight(done.returncode, done.stdout + done.stderr, run, json.loads((run / "summary.json").read_text()))


def test_the_map_of_another_process_lands_in_the_run_folder_and_makes_phi_jump(tmp_path: Path) -> None:
    flight = fly(tmp_path, EXAMPLE)

    assert flight.code == 0, flight.said
    assert flight.summary["jumps"] >= 3
    assert flight.summary["f_score_objects"] > 0.5
    assert len(trimesh.load_mesh(flight.folder / "mesh.ply").faces) > 2000
    assert "no map updates" not in flight.news


def test_a_flight_goes_on_with_the_map_it_has_when_that_process_is_killed(tmp_path: Path) -> None:
    (tmp_path / "mortal.py").write_text(MORTAL)
    flight = fly(tmp_path, str(tmp_path / "mortal.py"))

    assert flight.code == 1, "a process of the run failed"
    assert flight.summary["exit_reason"] == "duration of 8 s reached"
    assert re.search("mapper was killed by SIGKILL", flight.said)
    assert flight.news.count("the external map's process is gone: no map updates") == 1
    assert 1 <= flight.summary["jumps"] <= 3, "those of the maps before"
    assert len(trimesh.load_mesh(flight.folder / "mesh.ply").faces) > 100
