"""What a process makes of its command line."""

from __future__ import annotations

from pathlib import Path

import pytest

from protocol.process import parse

MISSION = "[[drones]]\nid = 1\nstart = [0, 1, 2, 0, 1.3]\n"


@pytest.mark.parametrize(
    ("kind", "speed", "lockstep"),
    [("simulated", "max", True), ("simulated", "1", False), ("px4", "max", False), ("px4", "1", False)],
)
def test_only_simulated_vehicles_can_be_made_to_wait(tmp_path: Path, kind: str, speed: str, *, lockstep: bool) -> None:
    path = tmp_path / "m.toml"
    path.write_text(f'[vehicles]\nkind = "{kind}"\n{MISSION}')
    arguments = ["--mission", str(path), "--endpoint", "tcp/127.0.0.1:1", "--run", str(tmp_path), "--speed", speed]
    assert parse("ground_station", arguments).lockstep is lockstep
