"""Whole missions in lockstep: simulated seconds a wall second, and memory."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

Record = Callable[..., None]
COVRECON = Path(sys.executable).with_name("covrecon")
LIMIT_S = 900
FLIGHT = """
name = "flight"
duration_s = 120
[simulation]
scene = ""
[reconstruction]
backend = "none"
[feedback]
method = "none"
"""
FULL = """
name = "full"
duration_s = 60
"""
FIELD = """
name = "field"
duration_s = 24
[target]
cell_m = {cell_m}
cell_rad = {cell_rad}
[simulation]
scene = ""
[reconstruction]
backend = "none"
[feedback]
method = "none"
"""
"""Long enough for a checkpoint, which takes a copy of phi."""
AGENT_MB, GROUND_MB, PHI_MB = 250, 2500, 200
"""Bars of memory; the last of all copies of phi that a process holds over the field of 1.5e7 cells."""


def fly(text: str, folder: Path, drones: int = 4) -> tuple[float, dict[str, int], dict[str, object]]:
    """Fly a team: simulated over wall seconds in flight, largest resident memory by module, the summary."""
    folder.mkdir(exist_ok=True)
    mission = folder / "mission.toml"
    mission.write_text(text)
    command = [COVRECON, "run", mission, "--drones", str(drones), "--speed", "max", "--headless", "--out", folder]
    run = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    memory: dict[str, int] = defaultdict(int)
    metrics = folder / "latest" / "metrics.csv"
    marks: list[tuple[float, float]] = []
    deadline = time.monotonic() + LIMIT_S
    while run.poll() is None:
        assert time.monotonic() < deadline
        _sample_memory(folder, memory)
        flown = _mission_time(metrics)
        if flown > 0 and (not marks or flown > marks[-1][1]):
            marks.append((time.monotonic(), flown))
        time.sleep(0.2)
    assert run.returncode == 0
    (began, first), (ended, last) = marks[0], marks[-1]
    return (last - first) / (ended - began), memory, json.loads((folder / "latest" / "summary.json").read_text())


def _mission_time(metrics: Path) -> float:
    if not metrics.exists():
        return 0.0
    rows = list(csv.DictReader(metrics.read_text().splitlines()))
    return float(rows[-1]["time_s"]) if rows and rows[-1]["time_s"] else 0.0


def _sample_memory(folder: Path, memory: dict[str, int]) -> None:
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            arguments = (entry / "cmdline").read_bytes().decode(errors="replace").split("\0")
            pages = int((entry / "statm").read_text().split()[1])
        except (OSError, IndexError):
            continue  # it ended while we looked
        if "-m" in arguments and any(argument.startswith(str(folder)) for argument in arguments):
            module = arguments[arguments.index("-m") + 1]
            memory[module] = max(memory[module], pages * 4096 // 10**6)


def test_lockstep_flight(record: Record, tmp_path: Path) -> None:
    speed, memory, _ = fly(FLIGHT, tmp_path)
    record("lockstep_flight_4", speed, "simulated s / wall s", "real time", speed)
    record("memory_agent", memory["agents"], "MB", f"limit of {AGENT_MB} MB", AGENT_MB / memory["agents"])


def test_lockstep_full(record: Record, tmp_path: Path) -> None:
    speed, memory, summary = fly(FULL, tmp_path)
    keyframes = float(str(summary["keyframes"])) / float(str(summary["sim_time_s"]))
    record("lockstep_full_4", speed, "simulated s / wall s", "real time", speed)
    record("keyframes_full_4", keyframes * speed, "keyframes / wall s", "25 a second", keyframes * speed / 25)
    ground = memory["ground_station"]
    record("memory_ground_station", ground, "MB", f"limit of {GROUND_MB} MB", GROUND_MB / ground)


def test_lockstep_full_field(record: Record, tmp_path: Path) -> None:
    """Two drones over 1.5e7 cells; what the processes take more than over the default field is phi."""
    _, small, _ = fly(FIELD.format(cell_m=0.3, cell_rad=0.3), tmp_path / "small", drones=2)
    speed, memory, _ = fly(FIELD.format(cell_m=0.1, cell_rad=0.12), tmp_path / "full", drones=2)
    record("lockstep_flight_15e6", speed, "simulated s / wall s", "real time", speed)
    for module in ("agents", "ground_station", "sim_bridge"):
        phi = max(1, memory[module] - small[module])
        record(f"memory_phi_{module}", phi, "MB", f"limit of {PHI_MB} MB", PHI_MB / phi)
