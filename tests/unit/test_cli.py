from __future__ import annotations

import io
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from cyclopts import App
from rich.console import Console

from deploy.cli import app
from protocol.guard import ROOT
from protocol.mission_file import load_mission, mission_to_json

PROCESSES = {"agent", "console", "ground", "px4-endpoint", "router", "sim"}
HELP_CPU_S = 1.0
"""Bound of processor time for --help: three times what it takes, so that only a heavy import breaks it."""


def covrecon(*arguments: str | Path, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    program = "from deploy.cli import main; main()"
    return subprocess.run(
        [sys.executable, "-P", "-c", program, *map(str, arguments)],
        cwd=cwd,
        env={"PYTHONPATH": str(ROOT), "PATH": "", "COLUMNS": "120"},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def test_help_answers_without_heavy_imports() -> None:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    result = covrecon("--help")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)

    assert result.returncode == 0
    assert {"agent", "ground", "mission", "report", "router", "run", "sim"} <= set(result.stdout.split())
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < HELP_CPU_S


def test_a_good_mission_is_said_to_be_ready() -> None:
    result = covrecon("mission", "check", "missions/demo.toml", "--drones", "6")

    assert (result.returncode, result.stderr) == (0, "")
    assert result.stdout == "missions/demo.toml: demo is ready to fly, drones: 6\n"


@pytest.mark.parametrize("command", [("run",), ("mission", "check"), ("mission", "show")])
def test_all_faults_of_a_mission_go_to_stderr_with_exit_code_2(tmp_path: Path, command: tuple[str, ...]) -> None:
    (tmp_path / "bad.toml").write_text('duration_s = "300"\nsed = 1\n')

    result = covrecon(*command, "bad.toml", "--drones", "2", cwd=tmp_path)

    assert result.returncode == 2
    assert result.stdout == ""
    assert result.stderr.splitlines() == [
        'bad.toml:1: duration_s: must be a valid number, got "300"',
        "bad.toml:2: sed: unknown key, did you mean seed?",
    ]
    assert [path.name for path in tmp_path.iterdir()] == ["bad.toml"]


@pytest.mark.parametrize("arguments", [("fly",), ("run",), ("run", "m.toml", "--speed", "2"), ("run", "--dronse", "2")])
def test_a_wrong_call_has_exit_code_2_and_says_why(arguments: tuple[str, ...]) -> None:
    result = covrecon(*arguments)

    assert result.returncode == 2
    assert "Error" in result.stdout + result.stderr
    assert "Traceback" not in result.stdout + result.stderr


def test_the_effective_mission_is_a_mission_file(tmp_path: Path) -> None:
    result = covrecon("mission", "show", "missions/demo.toml", "--drones", "5", "--seed", "8")
    shown = tmp_path / "shown.toml"
    shown.write_text(result.stdout)

    assert result.returncode == 0
    assert load_mission(shown) == load_mission(ROOT / "missions" / "demo.toml", drones=5, seed=8)


def test_the_schema_is_printed_as_it_is_committed() -> None:
    result = covrecon("mission", "schema")

    assert result.stdout == (ROOT / "protocol" / "mission.schema.json").read_text()


def test_the_report_of_a_run_that_was_cut_short_is_made_anew(tmp_path: Path) -> None:
    demo = load_mission(ROOT / "missions" / "demo.toml")
    (tmp_path / "mission.json").write_text(mission_to_json(demo))

    result = covrecon("report", tmp_path)

    assert (result.returncode, result.stderr) == (0, "")
    assert result.stdout == f"the run was cut short; report: {tmp_path}/report.html\n"
    assert (tmp_path / "report.html").stat().st_size > 0


def test_a_folder_without_a_run_has_no_report(tmp_path: Path) -> None:
    result = covrecon("report", tmp_path)

    assert result.returncode == 2
    assert f"{tmp_path}/mission.json: No such file or directory" in result.stderr
    assert "Traceback" not in result.stderr


def test_a_place_where_no_run_can_be_written_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()

    result = covrecon("run", "missions/demo.toml", "--out", tmp_path / "file")

    assert result.returncode == 1
    assert result.stderr.startswith(f"cannot write the run's folder in {tmp_path}/file: ")


def test_a_foreign_package_is_refused_before_anything_runs(tmp_path: Path) -> None:
    (tmp_path / "agents").mkdir()
    (tmp_path / "agents" / "__init__.py").touch()

    result = subprocess.run(
        [sys.executable, "-P", "-c", "from deploy.cli import main; main()", "--help"],
        env={"PYTHONPATH": f"{tmp_path}:{ROOT}"},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )

    assert result.returncode == 1
    assert result.stderr.startswith(f"package 'agents' would come from {tmp_path}/agents, not from ")


def test_every_command_has_an_example_in_its_help() -> None:
    def lacking(commands: App, path: tuple[str, ...]) -> Iterator[str]:
        for name in commands:
            words = (*path, name)
            if name.startswith("-") or name in PROCESSES:  # a process has its own help
                continue
            command = commands[name]
            if any(not below.startswith("-") for below in command):
                yield from lacking(command, words)
                continue
            text = io.StringIO()
            command.help_print(console=Console(file=text, width=200))
            usage, _, rest = text.getvalue().partition("\n")
            if f"covrecon {' '.join(words)}" not in rest:
                yield f"{' '.join(words)}: {usage}"

    assert list(lacking(app, ())) == []
