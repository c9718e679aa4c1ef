"""The launcher with small programs in place of the real processes: what matters is that nothing is left behind."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from deploy.local import Kind, Role, supervise
from protocol.errors import ProcessError
from protocol.guard import ROOT

PATIENCE_S = 30.0
"""Bound of every wait here; on a quiet machine each takes well under a second."""

ANNOUNCE = "import os, pathlib; pathlib.Path(os.environ['PIDS'], str(os.getpid())).touch()\n"
STAY = "import signal; signal.pause()"
STUBBORN = (
    "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('ready', flush=True)\n"
    "while True: signal.pause()"
)


def role(name: str, kind: Kind, program: str) -> Role:
    """A process that first leaves its id in a file beside the logs."""
    return Role(name, kind, (sys.executable, "-c", ANNOUNCE + program))


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A run folder with logs, ids of started processes, and a private folder that holds a socket's stand-in."""
    for name in ("logs", "pids", "private"):
        (tmp_path / name).mkdir()
    (tmp_path / "private" / "z.sock").touch()
    monkeypatch.setenv("PIDS", str(tmp_path / "pids"))
    yield tmp_path
    for pid in living(tmp_path):
        os.kill(pid, signal.SIGKILL)


def living(run: Path) -> list[int]:
    """Ids of started processes that still run; a zombie does not."""
    alive = []
    for file in (run / "pids").iterdir():
        try:
            state = Path("/proc", file.name, "stat").read_text().rpartition(") ")[2][0]
        except (FileNotFoundError, ProcessLookupError):
            continue
        if state not in "ZX":
            alive.append(int(file.name))
    return alive


def wait_for(condition: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"waited {PATIENCE_S:g} s for {what}"
        time.sleep(0.01)


def supervised(
    run: Path, *roles: Role, restarts: int = 0, grace_s: float = 5.0, settle_s: float = 20.0
) -> tuple[int, str]:
    """Exit code and what was said; afterwards nothing may be left."""
    said: list[str] = []
    code = asyncio.run(
        supervise(
            roles,
            logs=run / "logs",
            private=run / "private",
            say=said.append,
            restarts=restarts,
            grace_s=grace_s,
            settle_s=settle_s,
        )
    )
    assert living(run) == []
    assert not (run / "private").exists()
    return code, "\n".join(said)


def test_a_run_in_which_all_end_well_is_a_success(run: Path) -> None:
    code, said = supervised(
        run, role("sim", "sim", "pass"), role("ground", "ground", "print('hello')"), role("drone-1", "agent", "pass")
    )

    assert (code, said) == (0, "")
    assert (run / "logs" / "ground.log").read_text() == "hello\n"
    assert len(list((run / "pids").iterdir())) == 3


@pytest.mark.parametrize("kind", ["router", "sim", "ground"])
def test_the_failure_of_a_needed_process_ends_the_run_and_shows_its_log(run: Path, kind: Kind) -> None:
    other: Kind = "ground" if kind == "sim" else "sim"
    crash = "for line in range(100): print('line', line)\nraise SystemExit('the end of it')"

    code, said = supervised(run, role("broken", kind, crash), role(other, other, STAY), role("drone-1", "agent", STAY))

    assert code == 1
    assert "broken ended with exit code 1" in said
    assert said.endswith("line 99\n    the end of it")
    assert "line 80\n" not in said


def test_a_needed_process_that_refuses_its_input_gives_exit_code_2(run: Path) -> None:
    code, said = supervised(
        run, role("sim", "sim", "print('no such scene: barn'); raise SystemExit(2)"), role("ground", "ground", STAY)
    )

    assert code == 2
    assert "no such scene: barn" in said


def test_a_dead_drone_is_told_about_and_does_not_stop_the_others(run: Path) -> None:
    goes_on = (
        "import pathlib, os, time\nwhile not pathlib.Path(os.environ['PIDS'], '../go').exists(): time.sleep(0.01)\n"
    )
    dies = "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)"
    said: list[str] = []

    def say(text: str) -> None:
        said.append(text)
        (run / "go").touch()

    code = asyncio.run(
        supervise(
            [role("ground", "ground", goes_on), role("drone-1", "agent", dies), role("drone-2", "agent", goes_on)],
            logs=run / "logs",
            private=run / "private",
            say=say,
        )
    )

    assert code == 1
    assert len(said) == 1
    assert said[0].startswith("drone-1 was killed by SIGSEGV; end of ")


def test_a_run_whose_last_drone_died_is_ended(run: Path) -> None:
    code, said = supervised(
        run,
        role("sim", "sim", STAY),
        role("ground", "ground", STAY),
        role("drone-1", "agent", "raise SystemExit(1)"),
        role("drone-2", "agent", "raise SystemExit(1)"),
    )

    assert code == 1
    assert "drone-1 ended" in said
    assert "drone-2 ended" in said


def test_the_router_serves_until_all_others_have_ended_and_is_then_told_to_end(run: Path) -> None:
    files = (
        "import os, pathlib, signal, sys, time\n"
        "folder = pathlib.Path(os.environ['PIDS']).parent\n"
        "def wait_for(name):\n"
        "    while not (folder / name).exists(): time.sleep(0.01)\n"
    )
    serve = "signal.signal(signal.SIGTERM, lambda *_: sys.exit(f'told to end, sim done: {(folder / 'sim').exists()}'))"

    code, said = supervised(
        run,
        role("router", "router", files + serve.replace("'sim'", '"sim"') + "\n(folder / 'up').touch()\nsignal.pause()"),
        role("sim", "sim", files + "wait_for('ground'); (folder / 'sim').touch()"),
        role("ground", "ground", files + "wait_for('up'); (folder / 'ground').touch()"),
    )

    assert (code, said) == (0, "")
    assert (run / "logs" / "router.log").read_text() == "told to end, sim done: True\n"


DIES_FIRST = (
    "import os, pathlib, signal\n"
    "mark = pathlib.Path(os.environ['PIDS'], '../{name}')\n"
    "print('hello', flush=True)\n"
    "if len(mark.read_text() if mark.exists() else '') < {deaths}:\n"
    "    mark.open('a').write('x')\n"
    "    os.kill(os.getpid(), signal.SIGKILL)\n"
)
"""A process that is killed so many times before it goes on."""


def test_who_dies_is_started_again_and_then_counts_as_one_that_never_died(run: Path) -> None:
    waits = "import time\nwhile not (mark.parent / 'flies').exists(): time.sleep(0.01)\n"  # its end is the run's
    code, said = supervised(
        run,
        role("ground", "ground", DIES_FIRST.format(name="ground", deaths=2) + waits),
        role("drone-1", "agent", DIES_FIRST.format(name="drone-1", deaths=1) + "(mark.parent / 'flies').touch()\n"),
        restarts=3,
    )

    assert code == 0
    assert sorted(said.splitlines()) == [
        "drone-1 was killed by SIGKILL; started again (1 of 3)",
        "ground was killed by SIGKILL; started again (1 of 3)",
        "ground was killed by SIGKILL; started again (2 of 3)",
    ]
    assert (run / "logs" / "ground.log").read_text() == "hello\n" * 3


def test_who_dies_more_often_than_allowed_ends_the_run(run: Path) -> None:
    code, said = supervised(
        run,
        role("router", "router", STAY),
        role("sim", "sim", STAY),
        role("ground", "ground", "raise SystemExit('no use')"),
        restarts=2,
    )

    assert code == 1
    assert [line.partition("; ")[0] for line in said.splitlines()[:3]] == ["ground ended with exit code 1"] * 3
    assert said.endswith("no use")


@pytest.mark.parametrize(
    ("kind", "program", "code"), [("sim", "raise SystemExit(1)", 1), ("ground", "raise SystemExit(2)", 2)]
)
def test_neither_the_world_nor_who_refuses_its_input_is_started_again(
    run: Path, kind: Kind, program: str, code: int
) -> None:
    assert supervised(run, role("broken", kind, program), role("drone-1", "agent", STAY), restarts=3)[0] == code
    assert len(list((run / "pids").iterdir())) <= 2


def test_who_does_not_end_after_the_ground_station_is_ended(run: Path) -> None:
    code, said = supervised(
        run, role("sim", "sim", STAY), role("ground", "ground", "pass"), role("drone-1", "agent", "pass"), settle_s=0.2
    )

    assert code == 1
    assert said == "not ended 0.2 s after the ground station: sim"


def test_a_child_that_ignores_sigterm_is_killed_with_its_own_children(run: Path) -> None:
    parent = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {ANNOUNCE + STUBBORN!r}])"
    ready = (
        "import os, pathlib, time\nwhile len(list(pathlib.Path(os.environ['PIDS']).iterdir())) < 3: time.sleep(0.01)\n"
    )

    code, _ = supervised(
        run, role("sim", "sim", parent), role("ground", "ground", ready + "raise SystemExit(1)"), grace_s=0.3
    )

    assert code == 1


def test_a_command_that_does_not_exist_is_an_error_and_ends_what_was_started(run: Path) -> None:
    roles = [role("sim", "sim", STAY), Role("ground", "ground", ("/nowhere/python",))]

    with pytest.raises(ProcessError, match="ground: cannot start /nowhere/python: No such file"):
        supervised(run, *roles)

    assert living(run) == []
    assert not (run / "private").exists()


LAUNCHER = """
    import asyncio, json, signal, sys
    from pathlib import Path
    from deploy.local import Role, supervise
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # whoever runs the tests may ignore it
    run, roles = Path(sys.argv[1]), [Role(*role) for role in json.loads(sys.argv[2])]
    def say(text): print(text, flush=True)
    sys.exit(asyncio.run(supervise(roles, logs=run / "logs", private=run / "private", say=say, grace_s=0.5)))
"""


def launcher(run: Path, *roles: Role) -> subprocess.Popen[str]:
    """A launcher as a process of its own, with all its children up."""
    listed = json.dumps([[role.name, role.kind, role.command] for role in roles])
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(LAUNCHER), str(run), listed],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    wait_for(lambda: len(living(run)) == len(roles), "the processes to start")
    return process


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_all_and_is_told_by_the_exit_code(run: Path, number: signal.Signals) -> None:
    with launcher(run, role("sim", "sim", STAY), role("ground", "ground", STAY), role("d", "agent", STAY)) as process:
        process.send_signal(number)
        said, _ = process.communicate(timeout=PATIENCE_S)

    assert process.returncode == 128 + number
    assert said == f"{number.name}: ending the run\n"
    assert living(run) == []
    assert not (run / "private").exists()


def test_a_killed_launcher_leaves_neither_processes_nor_socket(run: Path) -> None:
    stubborn = role("ground", "ground", STUBBORN)
    with launcher(run, role("sim", "sim", STAY), stubborn, role("drone-1", "agent", STAY)) as process:
        wait_for(lambda: (run / "logs" / "ground.log").read_text() == "ready\n", "the stubborn process")
        process.kill()

    wait_for(lambda: living(run) == [], "the processes to be ended")
    wait_for(lambda: not (run / "private").exists(), "the socket's folder to be removed")


def test_nothing_is_left_when_the_reaper_is_killed_too(run: Path) -> None:
    with launcher(run, role("sim", "sim", STAY), role("ground", "ground", STUBBORN)) as process:
        group = os.getpgid(living(run)[0])
        assert group != os.getpgid(process.pid)
        os.kill(group, signal.SIGKILL)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=PATIENCE_S)

    assert process.returncode == 128 + signal.SIGINT
    wait_for(lambda: living(run) == [], "the processes to be ended")
    assert not (run / "private").exists()
