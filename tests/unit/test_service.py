"""What systemd and a container's health check hear of a process, over a real socket and from a real process."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from deploy.local import environment
from deploy.run_folder import socket_endpoint
from protocol import service
from protocol.guard import ROOT
from protocol.service import HEARTBEAT, PERIOD_S, SOCKET, WATCHDOG, Service

PATIENCE_S = 20.0
BEATS_US = 20_000
"""What a test's systemd is patient for: a beat comes every 10 ms."""
PROCESS = """
import asyncio, sys
from protocol import service
from protocol.process import run_process

async def body(arguments):
    service.ready("connected to " + arguments.mission.name)
    await asyncio.Event().wait()

sys.exit(run_process("sim_bridge", body))
"""


class Listener:
    """systemd's end of the socket."""

    def __init__(self, address: str) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(address)
        self._socket.settimeout(PATIENCE_S)

    def hear(self) -> dict[str, str]:
        """The next message, in arrears or not."""
        return dict(line.split("=", 1) for line in self._socket.recv(4096).decode().splitlines())

    async def hear_soon(self) -> dict[str, str]:
        return await asyncio.to_thread(self.hear)

    def hears(self, within_s: float) -> bool:
        """Whether anything comes in so short a time."""
        self._socket.settimeout(within_s)
        try:
            self._socket.recv(4096)
        except (TimeoutError, BlockingIOError):
            return False
        finally:
            self._socket.settimeout(PATIENCE_S)
        return True

    def forget(self) -> None:
        """All that has come."""
        while self.hears(0):
            pass

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def listener(tmp_path: Path) -> Iterator[Listener]:
    listening = Listener(str(tmp_path / "notify"))
    yield listening
    listening.close()


def variables(tmp_path: Path, **more: str) -> dict[str, str]:
    return {SOCKET: str(tmp_path / "notify"), WATCHDOG: str(BEATS_US), **more}


async def test_systemd_hears_when_it_is_ready_that_it_lives_and_that_it_ends(
    tmp_path: Path, listener: Listener
) -> None:
    async with service.told(variables(tmp_path)):
        assert not await asyncio.to_thread(listener.hears, 5 * BEATS_US / 1e6), "told before it was ready"
        service.ready("connected to\ntcp/router:7447")
        first, second = await listener.hear_soon(), await listener.hear_soon()
        assert first == second == {"READY": "1", "WATCHDOG": "1", "STATUS": "connected to tcp/router:7447"}

    while (heard := await listener.hear_soon()) == first:
        pass
    assert heard == {"STOPPING": "1", "STATUS": "ending"}


async def test_a_loop_that_hangs_falls_silent(tmp_path: Path, listener: Listener) -> None:
    held = threading.Event()
    found: list[bool] = []

    def judge() -> None:
        listener.forget()
        found.append(listener.hears(10 * BEATS_US / 1e6))
        held.set()

    async with service.told(variables(tmp_path)):
        service.ready("flying")
        await listener.hear_soon()
        judging = threading.Thread(target=judge)
        judging.start()
        held.wait(PATIENCE_S)  # blocks the loop, as a computation would
        judging.join()
        assert found == [False]
        assert (await listener.hear_soon())["WATCHDOG"] == "1"


def test_an_abstract_socket_is_known_by_its_sign() -> None:
    name = f"covrecon-{os.getpid()}-{threading.get_ident()}"
    listening = Listener(f"\0{name}")
    Service({SOCKET: f"@{name}"}).ready("listening")

    assert listening.hear()["STATUS"] == "listening"
    listening.close()


async def test_a_heartbeat_file_grows_young_with_each_beat(tmp_path: Path) -> None:
    file = tmp_path / "alive"
    told = Service({HEARTBEAT: str(file)})
    told.beat()
    assert not file.exists(), "touched before it was ready"

    told.ready("flying")
    os.utime(file, (0, 0))
    told.beat()
    assert file.stat().st_mtime > 0


def test_without_a_listener_nothing_is_told_and_nothing_fails(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        service.ready("in no process of a mission")
        told = Service({})
        told.ready("flying")
        told.stopping()
    assert not caplog.records


@pytest.mark.parametrize("address", ["/nowhere/notify", "relative", "@", "vsock:2:1", "/" + "long" * 50])
def test_a_socket_that_fails_costs_one_warning(address: str, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        told = Service({SOCKET: address})
        told.ready("flying")
        told.beat()
        told.stopping()
    assert [record.message.split(":")[0] for record in caplog.records] == [SOCKET]


def test_a_listener_that_does_not_read_holds_nobody_up(tmp_path: Path, listener: Listener) -> None:
    told = Service({SOCKET: str(tmp_path / "notify")})
    for _ in range(10_000):  # more than any socket's buffer holds
        told.ready("flying")
    assert listener.hear()["READY"] == "1"


def test_a_heartbeat_file_that_cannot_be_written_costs_one_warning(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        told = Service({HEARTBEAT: "/nowhere/alive"})
        told.ready("flying")
        told.beat()
    assert [record.message.split(":")[0] for record in caplog.records] == [HEARTBEAT]


@pytest.mark.parametrize(("patience", "period_s"), [("10000000", 5.0), ("0", PERIOD_S), ("soon", PERIOD_S)])
def test_it_beats_twice_in_what_systemd_waits(patience: str, period_s: float) -> None:
    assert Service({WATCHDOG: patience}).period_s == period_s


@pytest.mark.processes
@pytest.mark.light
def test_a_process_tells_systemd_from_its_start_to_its_end(tmp_path: Path, listener: Listener) -> None:
    mission = ROOT / "missions" / "demo.toml"
    arguments = ["--mission", str(mission), "--endpoint", "tcp/127.0.0.1:1", "--run", str(tmp_path)]
    process = subprocess.Popen(
        [sys.executable, "-P", "-c", PROCESS, *arguments], env=environment(os.environ) | variables(tmp_path)
    )
    try:
        assert listener.hear() == {"READY": "1", "WATCHDOG": "1", "STATUS": "connected to demo"}
        process.send_signal(signal.SIGTERM)
        while (heard := listener.hear()).get("READY"):
            pass
        assert heard == {"STOPPING": "1", "STATUS": "ending"}
        assert process.wait(PATIENCE_S) == 143
    finally:
        process.kill()
        process.wait()


@pytest.mark.processes
@pytest.mark.light
def test_a_router_is_ready_once_it_listens_and_its_client_once_it_is_connected(
    tmp_path: Path, listener: Listener
) -> None:
    mission, endpoint = tmp_path / "mission.toml", socket_endpoint(tmp_path)
    mission.write_text('[simulation]\nscene = ""\n[[drones]]\nid = 1\nstart = [0, 1, 2, 0, 1.3]\n')
    told = environment(os.environ) | variables(tmp_path)
    processes = []
    try:
        for module, status in (("protocol.router", "listening at"), ("sim_bridge", "connected to")):
            command = [sys.executable, "-P", "-m", module, "--mission", mission, "--endpoint", endpoint]
            processes.append(subprocess.Popen([*command, "--run", tmp_path], env=told))
            while (heard := listener.hear())["STATUS"] != f"{status} {endpoint}":
                assert heard["READY"] == "1"
    finally:
        for process in processes:
            process.terminate()
            process.wait(PATIENCE_S)
