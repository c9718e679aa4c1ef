"""TAB in a real bash, with the script that ``covrecon completion`` prints."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
from cyclopts import App

from deploy.cli import app
from deploy.completion_command import Shell, completion_of

BASH = shutil.which("bash") or ""
pytestmark = [
    pytest.mark.light,
    pytest.mark.skipif(not BASH, reason="there is no bash to complete in"),
]

PRESS_TAB = """
source "$1"
shift
COMP_WORDS=("$@")
COMP_CWORD=$(($# - 1))
_covrecon
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.fixture(scope="module")
def script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("completion") / "covrecon"
    path.write_text(app.generate_completion(shell="bash"))  # noqa: S604  # names a shell, starts none
    return path


def offered(script: Path, *words: str) -> set[str]:
    """What bash offers when TAB is pressed after ``words``, the last of them unfinished."""
    done = subprocess.run(
        [BASH, "-c", PRESS_TAB, "bash", str(script), "covrecon", *words],
        capture_output=True,
        text=True,
        timeout=30,
        check=True,
    )
    assert done.stderr == ""
    return set(done.stdout.split())


def test_every_command_is_offered(script: Path) -> None:
    commands = {name for name in app if not name.startswith("-")}

    assert {"mission", "report", "run"} <= commands
    assert offered(script, "") == commands


def test_a_command_that_was_begun_is_completed(script: Path) -> None:
    assert offered(script, "miss") == {"mission"}
    assert offered(script, "mission", "sch") == {"schema"}


def test_options_are_offered_by_command(script: Path) -> None:
    assert {"--drones", "--headless", "--out", "--seed", "--speed"} <= offered(script, "run", "--")
    assert "--speed" not in offered(script, "mission", "show", "--")


def test_the_values_of_a_choice_are_offered(script: Path) -> None:
    assert offered(script, "run", "missions/demo.toml", "--speed", "") == {"1", "max"}
    assert offered(script, "run", "--vehicles", "px") == {"px4", "px4-endpoint"}


def test_files_are_offered_where_a_file_is_wanted(
    script: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "workshop.toml").touch()
    monkeypatch.chdir(tmp_path)

    assert offered(script, "run", "work") == {"workshop.toml"}


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_command_prints_the_script_of_the_app_that_it_is_given(
    shell: Shell, capsys: pytest.CaptureFixture[str]
) -> None:
    small = App(name="small")
    small.command(completion_of(small), name="completion")
    small(["completion", shell], result_action="return_value")

    printed = capsys.readouterr().out
    assert printed == small.generate_completion(shell=shell)
    assert "completion" in printed
