"""Commands on disk: a ground station that is started again knows them, whatever the crash did to the file."""

from __future__ import annotations

from pathlib import Path

import pytest

from ground_station.command_log import CommandLog
from ground_station.commands import Command

PAUSE = Command("a1", "pause", (1, 2), 1)
LAND = Command("b2", "land", (2,), 2)


def test_commands_are_found_again_in_order(tmp_path: Path) -> None:
    with CommandLog(tmp_path / "commands") as log:
        assert log.append(PAUSE)
        assert log.append(LAND)
    with CommandLog(tmp_path / "commands") as log:
        assert log.earlier == [PAUSE, LAND]


def test_what_a_crash_tore_is_written_over(tmp_path: Path) -> None:
    path = tmp_path / "commands"
    with CommandLog(path) as log:
        log.append(PAUSE)
        log.append(LAND)
    whole = path.read_bytes()
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        with CommandLog(path) as log:
            assert log.earlier in ([], [PAUSE])
            log.append(LAND)
        with CommandLog(path) as log:
            assert log.earlier[-1] == LAND


def test_damage_is_told_and_costs_only_the_damaged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "commands"
    with CommandLog(path) as log:
        log.append(PAUSE)
        log.append(LAND)
    content = bytearray(path.read_bytes())
    content[30] ^= 0xFF
    path.write_bytes(content)
    with CommandLog(path) as log:
        assert log.earlier == [LAND]
    assert "damaged" in caplog.text
