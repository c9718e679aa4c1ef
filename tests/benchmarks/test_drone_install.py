"""What a drone carries: an installation made as `deploy/docker/Dockerfile` makes it, its size, start and memory."""

from __future__ import annotations

import asyncio
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from deploy.run_folder import socket_endpoint
from protocol.bus import connect
from protocol.guard import PACKAGES, ROOT

Record = Callable[..., None]

LIMIT_S = 600.0
DISK_MB, START_S, MEMORY_MB = 1000, 5.0, 250
"""Bars of what a drone's computer can spare."""
REPEATS = 3
MISSION = """
name = "installed"
[simulation]
scene = ""
[[drones]]
id = 1
start = [0.0, 1.0, 2.0, 0.0, 1.3]
"""

pytestmark = pytest.mark.timeout(LIMIT_S)  # a package index may be far


@dataclass(frozen=True, slots=True)
class Installed:
    root: Path
    """Takes the place of /opt/covrecon."""
    install_s: float

    @property
    def python(self) -> Path:
        return self.root / "venv" / "bin" / "python"

    @property
    def environment(self) -> dict[str, str]:
        cache = self.root.parent / "numba"
        return {"PATH": os.environ["PATH"], "PYTHONPATH": str(self.root), "NUMBA_CACHE_DIR": str(cache)}

    def run(self, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [self.python, "-P", *arguments], env=self.environment, cwd="/", capture_output=True, text=True, check=False
        )


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Installed]:
    folder = tmp_path_factory.mktemp("drone")
    root, build = folder / "covrecon", folder / "build"
    build.mkdir()
    for name in ("pyproject.toml", "constraints.txt", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, build)
    for package in PACKAGES:
        shutil.copytree(ROOT / package, root / package, ignore=shutil.ignore_patterns("__pycache__"))
    began = time.monotonic()
    subprocess.run([sys.executable, "-m", "venv", root / "venv"], check=True)
    pip = [root / "venv" / "bin" / "python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*pip, "--constraint", "constraints.txt", "."], cwd=build, check=True)
    yield Installed(root, time.monotonic() - began)
    shutil.rmtree(folder)


def size_mb(folder: Path) -> float:
    """On disk."""
    return sum(path.lstat().st_blocks * 512 for path in folder.rglob("*")) / 1e6


def modules(installed: Installed, *names: str) -> list[str]:
    """Those of ``names`` that can be imported."""
    code = f"import importlib.util as u; print(*(n for n in {names!r} if u.find_spec(n)))"
    done = installed.run("-c", code)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_a_drone_carries_neither_open3d_nor_torch(installed: Installed, record: Record) -> None:
    assert modules(installed, "open3d", "torch", "zenoh", "mavsdk") == ["zenoh", "mavsdk"]
    packages = installed.root / "venv" / "lib"
    assert not [path for path in packages.rglob("*") if path.parent.name == "site-packages" and path.name in PACKAGES]

    venv, source = size_mb(installed.root / "venv"), sum(size_mb(installed.root / package) for package in PACKAGES)
    record("drone_install_disk", venv + source, "MB", f"limit of {DISK_MB} MB", DISK_MB / (venv + source))
    record("drone_install_time", installed.install_s, "s, download included", "1 minute", 60 / installed.install_s)


def test_an_agent_starts_and_stays_small(installed: Installed, record: Record, tmp_path: Path) -> None:
    told = installed.run("-m", "agents", "--help")
    assert told.returncode == 0, told.stderr
    assert "--drone" in told.stdout

    mission = tmp_path / "mission.toml"
    mission.write_text(MISSION)
    compiled = installed.run("-m", "deploy.compilation", mission)
    assert compiled.returncode == 0, compiled.stderr
    found = [asyncio.run(start(installed, mission, tmp_path)) for _ in range(REPEATS)]
    seconds, megabytes = min(second for second, _ in found), max(memory for _, memory in found)
    record("drone_agent_start", seconds, "s until all hear of it", f"limit of {START_S:g} s", START_S / seconds)
    record("drone_agent_memory", megabytes, "MB", f"limit of {MEMORY_MB} MB", MEMORY_MB / megabytes)


async def start(installed: Installed, mission: Path, folder: Path) -> tuple[float, float]:
    """Seconds from the start of an agent's process until it is announced, and its resident memory then."""
    endpoint = socket_endpoint(folder)
    command = [installed.python, "-P", "-m", "agents", "--mission", mission, "--endpoint", endpoint, "--run", folder]
    async with connect(endpoint, "installed", router=True) as bus:
        bus.watch_lives()
        began = time.monotonic()
        agent = await asyncio.create_subprocess_exec(*command, "--drone", "1", env=installed.environment)
        try:
            assert await bus.until(lambda: "drone/1" in bus.alive, LIMIT_S)
            return time.monotonic() - began, resident_mb(agent.pid)
        finally:
            agent.terminate()
            await agent.wait()


def resident_mb(process: int) -> float:
    pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
