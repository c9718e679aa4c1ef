from __future__ import annotations

import json
import tempfile
from datetime import UTC, datetime
from pathlib import Path

import pytest

from deploy.run_folder import SOCKET_PATH_MAX, make_run_folder, socket_endpoint, socket_folder_parent
from protocol.errors import ProcessError
from protocol.guard import ROOT
from protocol.mission_file import load_mission

DEMO = load_mission(ROOT / "missions" / "demo.toml", seed=11)
STARTED = datetime(2026, 11, 22, 9, 8, 7, tzinfo=UTC)


def test_a_run_folder_holds_what_repeats_the_run(tmp_path: Path) -> None:
    run = make_run_folder(tmp_path / "runs", DEMO, STARTED, "tcp/127.0.0.1:7447")

    assert run == tmp_path / "runs" / "2026-11-22T09-08-07Z"
    assert load_mission(run / "mission.toml") == load_mission(run / "mission.json") == DEMO
    record = json.loads((run / "run.json").read_text())
    assert (record["seed"], record["started"], record["endpoint"]) == (
        11,
        "2026-11-22T09:08:07+00:00",
        "tcp/127.0.0.1:7447",
    )
    assert record["packages"]["pydantic"]
    assert (run / "logs").is_dir()


def test_latest_points_to_the_newest_run_and_no_run_is_overwritten(tmp_path: Path) -> None:
    first, second = (make_run_folder(tmp_path, DEMO, STARTED, "") for _ in range(2))

    assert first != second
    assert (tmp_path / "latest").resolve() == second
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([first.name, second.name, "latest"])


def test_a_folder_named_latest_is_not_touched(tmp_path: Path) -> None:
    (tmp_path / "latest").mkdir()

    with pytest.raises(ProcessError, match="cannot write the run's folder"):
        make_run_folder(tmp_path, DEMO, STARTED, "")


def test_the_socket_avoids_folders_that_are_too_deep_or_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    deep = tmp_path / ("d" * 100)
    deep.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", "/tmp")

    for unusable in (str(deep), str(tmp_path / "missing"), ""):
        monkeypatch.setenv("XDG_RUNTIME_DIR", unusable)
        assert socket_folder_parent() == Path("/tmp")
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/var/tmp")
    assert socket_folder_parent() == Path("/var/tmp")


def test_the_socket_path_fits() -> None:
    private = socket_folder_parent() / "covrecon-12345678"

    endpoint = socket_endpoint(private)

    assert endpoint == f"unixsock-stream/{private}/z.sock"
    assert len(endpoint.removeprefix("unixsock-stream/")) <= SOCKET_PATH_MAX
