"""The folder that a run leaves behind, and the place of its socket."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import sys
import tempfile
from datetime import datetime
from pathlib import Path

from protocol.errors import ProcessError
from protocol.mission import Mission
from protocol.mission_file import mission_to_json, mission_to_toml

SOCKET_PATH_MAX = 107
"""Bytes that Linux allows for the path of a unix socket."""


def socket_folder_parent() -> Path:
    """Where to make a private folder: writable, with a path short enough for a socket below.

    A run folder may lie arbitrarily deep, so the socket cannot live there; ``run.json`` tells where it is.
    """
    candidates = [os.environ.get("XDG_RUNTIME_DIR", ""), tempfile.gettempdir(), "/tmp"]  # noqa: S108  # only a parent
    for parent in candidates:
        if parent and os.access(parent, os.W_OK | os.X_OK) and len(os.fsencode(parent)) < SOCKET_PATH_MAX // 2:
            return Path(parent)
    raise ProcessError(f"no writable folder with a short path for the socket; tried {', '.join(candidates)}")


def socket_endpoint(private: Path) -> str:
    """zenoh's name for the socket in a private folder."""
    return f"unixsock-stream/{private / 'z.sock'}"


def make_run_folder(out: Path, mission: Mission, started: datetime, endpoint: str) -> Path:
    """Make ``out/<UTC time>`` with the effective mission, ``run.json`` and ``logs``, and point ``out/latest`` to it.

    The path is absolute. Raises `ProcessError` when it cannot be written.
    """
    try:
        run = _new_folder(out.resolve(), started)
        (run / "logs").mkdir()
        (run / "mission.json").write_text(mission_to_json(mission))
        (run / "mission.toml").write_text(mission_to_toml(mission))
        (run / "run.json").write_text(json.dumps(_record(mission, started, endpoint), indent=2) + "\n")
        _point_to(run, out.resolve() / "latest")
    except OSError as error:
        raise ProcessError(f"cannot write the run's folder in {out}: {error.strerror}: {error.filename}") from error
    return run


def _new_folder(out: Path, started: datetime) -> Path:
    out.mkdir(parents=True, exist_ok=True)
    name = started.strftime("%Y-%m-%dT%H-%M-%SZ")
    for attempt in range(1, 100):  # runs that start within one second
        folder = out / (name if attempt == 1 else f"{name}-{attempt}")
        try:
            folder.mkdir()
        except FileExistsError:
            continue
        return folder
    raise ProcessError(f"{out}: a hundred runs named {name}")


def _record(mission: Mission, started: datetime, endpoint: str) -> dict[str, object]:
    installed = {found.name: found.version for found in importlib.metadata.distributions()}
    return {
        "started": started.isoformat(timespec="seconds"),
        "command": sys.argv,
        "seed": mission.seed,
        "endpoint": endpoint,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "packages": dict(sorted(installed.items())),
    }


def _point_to(run: Path, link: Path) -> None:
    """Replace the link in one step: a reader never finds it missing."""
    temporary = link.with_name(f".latest-{run.name}")
    temporary.symlink_to(run.name)
    temporary.replace(link)
