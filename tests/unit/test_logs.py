"""What a process's log looks like, to people and to machines."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import threading
import warnings
from collections.abc import Iterator
from typing import Any

import pytest

from protocol.errors import MissionError, ProcessError
from protocol.guard import ROOT
from protocol.logs import configure, say_last

log = logging.getLogger("ground_station.status")


@pytest.fixture(autouse=True)
def _own_logging() -> Iterator[None]:
    """`configure` is for whole processes: give the test run its own logging back."""
    root = logging.getLogger()
    handlers, level, hook, thread_hook = root.handlers[:], root.level, sys.excepthook, threading.excepthook
    root.handlers = []
    yield
    root.handlers = handlers
    root.setLevel(level)
    logging.captureWarnings(capture=False)
    sys.excepthook = hook
    threading.excepthook = thread_hook


def records(capsys: pytest.CaptureFixture[str]) -> list[dict[str, Any]]:
    return [json.loads(line) for line in capsys.readouterr().err.splitlines()]


def fail() -> None:
    secret = "token"  # noqa: F841, S105  # must not be written
    raise ProcessError("the simulator is gone")


def test_a_line_for_people_has_time_level_logger_and_text(capsys: pytest.CaptureFixture[str]) -> None:
    configure("ground_station", "demo", environment={})
    log.warning("%s is gone", "drone/1")

    kept = logging.LogRecord("ground_station.status", logging.WARNING, "", 0, "drone/1 is gone", (), None)
    usual = logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s").format(kept)
    line = capsys.readouterr().err
    assert line[23:] == usual[23:] + "\n"
    assert len(line.split(",")[0]) == len("2026-11-22 20:23:49")


def test_a_record_for_machines_says_which_process_it_came_from(capsys: pytest.CaptureFixture[str]) -> None:
    configure("agents", "demo", 3, environment={"COVRECON_LOG": "json"})
    log.info("tick %d: telemetry is sound again", 7, extra={"tick": 7})

    (record,) = records(capsys)
    assert record.pop("time").endswith("+00:00")
    assert record == {
        "level": "info",
        "logger": "ground_station.status",
        "event": "tick 7: telemetry is sound again",
        "role": "agents",
        "mission": "demo",
        "drone": 3,
        "tick": 7,
    }


def test_extras_follow_the_text_for_people(capsys: pytest.CaptureFixture[str]) -> None:
    configure("agents", environment={})
    log.info("sound again", extra={"tick": 7})

    assert capsys.readouterr().err.endswith(": sound again tick=7\n")


def test_an_exception_is_a_structure_for_machines_without_local_variables(capsys: pytest.CaptureFixture[str]) -> None:
    configure("agents", environment={"COVRECON_LOG": "json"})
    try:
        fail()
    except ProcessError:
        log.exception("failed")

    said = capsys.readouterr().err
    (trace,) = json.loads(said)["exception"]
    assert (trace["exc_type"], trace["exc_value"]) == ("ProcessError", "the simulator is gone")
    assert [frame["name"] for frame in trace["frames"]][-1] == "fail"
    assert "token" not in said


def test_an_exception_is_a_traceback_for_people(capsys: pytest.CaptureFixture[str]) -> None:
    configure("agents", environment={})
    try:
        fail()
    except ProcessError:
        log.exception("failed")

    lines = capsys.readouterr().err.splitlines()
    assert lines[0].endswith("ERROR ground_station.status: failed")
    assert lines[1] == "Traceback (most recent call last):"
    assert lines[-1] == "protocol.errors.ProcessError: the simulator is gone"


def test_text_from_others_cannot_pass_for_a_line_of_its_own(capsys: pytest.CaptureFixture[str]) -> None:
    configure("agents", environment={})
    log.info("finished: %s", "done\n2026-11-22 20:23:49,793 ERROR agents.agent: crash")

    first, second = capsys.readouterr().err.splitlines()
    assert first.endswith("finished: done")
    assert second.startswith("    2026")


def test_warnings_of_libraries_are_records(capsys: pytest.CaptureFixture[str]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        configure("agents", environment={"COVRECON_LOG": "json"})
        warnings.warn("this will go away", stacklevel=1)

    (record,) = records(capsys)
    assert record["logger"] == "py.warnings"
    assert "this will go away" in record["event"]


def test_configuring_again_replaces_what_was(capsys: pytest.CaptureFixture[str]) -> None:
    configure("agents", environment={"COVRECON_LOG": "json"})
    configure("agents", "demo", environment={"COVRECON_LOG": "json"})
    log.info("once")

    assert [record["mission"] for record in records(capsys)] == ["demo"]


def test_what_ended_a_process_is_bare_for_people_and_a_record_for_machines(capsys: pytest.CaptureFixture[str]) -> None:
    error = MissionError(["m.toml:1: sed: unknown key", "m.toml:2: x: unknown key"])
    configure("agents", environment={})
    say_last(error)
    bare = capsys.readouterr().err
    configure("agents", environment={"COVRECON_LOG": "json"})
    say_last(error)

    assert bare == "m.toml:1: sed: unknown key\nm.toml:2: x: unknown key\n"
    (record,) = records(capsys)
    assert (record["level"], record["event"]) == ("critical", str(error))


def test_an_unknown_format_is_refused_with_those_there_are() -> None:
    with pytest.raises(ProcessError, match="COVRECON_LOG=xml: must be one of human, json"):
        configure("agents", environment={"COVRECON_LOG": "xml"})


@pytest.mark.light
def test_every_line_of_a_process_that_crashes_is_a_record() -> None:
    program = """
import threading
from protocol.logs import configure
configure("agents")
thread = threading.Thread(target=lambda: [][1], name="mapper")
thread.start()
thread.join()
1 / 0
"""
    result = subprocess.run(
        [sys.executable, "-P", "-c", program],
        env=os.environ | {"PYTHONPATH": str(ROOT), "COVRECON_LOG": "json"},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )

    assert result.returncode == 1
    thread, main = (json.loads(line) for line in result.stderr.splitlines())
    assert thread["event"] == "uncaught IndexError in thread mapper"
    assert main["event"] == "uncaught ZeroDivisionError"
    assert main["exception"][0]["exc_type"] == "ZeroDivisionError"
