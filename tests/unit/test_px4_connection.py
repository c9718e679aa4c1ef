"""One process has one port and one vehicle; everybody else is refused, and told who has it."""

from __future__ import annotations

import asyncio
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common

from agents.vehicles.px4.connection import Connection
from agents.vehicles.px4.locks import MachineLock
from protocol.errors import VehicleError

pytestmark = pytest.mark.processes

HEARTBEATS_HZ = 20.0


@pytest.fixture(autouse=True)
def _own_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other tests of this machine fly the same system ids."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))


@pytest.fixture
def port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        number: int = probe.getsockname()[1]
    return number


@pytest.fixture
def url(port: int) -> str:
    return f"udpin://127.0.0.1:{port}"


@pytest.fixture
def other_port() -> Iterator[int]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        number: int = probe.getsockname()[1]
        probe.close()
        yield number


class Heartbeats:
    """Autopilots of these system ids, heard on one port."""

    def __init__(self, port: int, *systems: int) -> None:
        self._port, self._systems = port, systems
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._send)

    def _send(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as outlet:
            codecs = [common.MAVLink(None, system, 1) for system in self._systems]
            while not self._ended.wait(1.0 / HEARTBEATS_HZ):
                for codec in codecs:
                    heartbeat = common.MAVLink_heartbeat_message(
                        common.MAV_TYPE_QUADROTOR, common.MAV_AUTOPILOT_PX4, 0, 0, 3, 3
                    )
                    outlet.sendto(heartbeat.pack(codec), ("127.0.0.1", self._port))

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()


async def discover(connection: Connection, timeout_s: float = 20.0) -> int:
    try:
        connection.open()
        system = await connection.discover(timeout_s, time.monotonic)
        number: int = system.get_system_id()
        return number
    finally:
        connection.close()


async def test_the_expected_vehicle_is_found(url: str, port: int) -> None:
    with Heartbeats(port, 3):
        assert await discover(Connection(url, 3, "drone 3")) == 3


async def test_somebody_elses_vehicle_is_refused(url: str, port: int) -> None:
    with Heartbeats(port, 7), pytest.raises(VehicleError, match="system 7 is heard, where 3 is expected, alone"):
        await discover(Connection(url, 3, "drone 3"))


async def test_a_vehicle_that_is_not_alone_on_its_port_is_refused(url: str, port: int) -> None:
    with Heartbeats(port, 3, 7), pytest.raises(VehicleError, match="system 7 is heard, where 3 is expected, alone"):
        await discover(Connection(url, 3, "drone 3"))


async def test_nobody_there_is_said_after_the_time_for_it(url: str) -> None:
    with pytest.raises(VehicleError, match=f"{url}: no vehicle was heard for 0.3 s"):
        await discover(Connection(url, 3, "drone 3"), 0.3)


@pytest.mark.parametrize(
    "url",
    [
        "",
        "14540",
        "udp://:14540",
        "udpin://127.0.0.1",
        "udpin://127.0.0.1:0",
        "udpin://127.0.0.1:65536",
        "http://a:80",
        "serial://",
    ],
)
def test_what_is_no_connection_is_refused_by_name(url: str) -> None:
    with pytest.raises(VehicleError, match="is no connection: udpin://"):
        Connection(url, 3, "drone 3")


def test_what_mavsdk_refuses_is_told_and_leaves_nothing_locked() -> None:
    connection = Connection("serial:///dev/no-such-port:57600", 3, "drone 3")
    with pytest.raises(VehicleError, match="connecting to serial:///dev/no-such-port:57600: Connection failed"):
        connection.open()
    connection.close()

    Connection("serial:///dev/no-such-port:57600", 3, "drone 3").close()


def test_a_port_is_given_to_one_and_the_other_learns_to_whom(url: str) -> None:
    first = Connection(url, 3, "drone 3 of mission 'a'")
    with pytest.raises(VehicleError, match=rf"udp port \d+ is taken by drone 3 of mission 'a', process {os.getpid()} "):
        Connection(url, 4, "drone 4")
    first.close()

    Connection(url, 4, "drone 4").close()


def test_a_system_is_given_to_one_on_whatever_port(url: str, other_port: int) -> None:
    first = Connection(url, 3, "drone 3 of mission 'a'")
    with pytest.raises(VehicleError, match="vehicle system 3 is taken by drone 3 of mission 'a'"):
        Connection(f"udpin://127.0.0.1:{other_port}", 3, "drone 3 of mission 'b'")
    first.close()


def test_one_that_was_refused_keeps_nothing(url: str, other_port: int) -> None:
    first = Connection(url, 3, "drone 3")
    with pytest.raises(VehicleError):
        Connection(f"udpin://127.0.0.1:{other_port}", 3, "drone 3 again")

    Connection(f"udpin://127.0.0.1:{other_port}", 4, "drone 4").close()
    first.close()


def test_a_port_that_another_program_has_is_refused_though_it_would_share(url: str, port: int) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as MAVSDK and ground stations do
        other.bind(("", port))
        with pytest.raises(VehicleError, match=f"udp port {port} cannot be had, perhaps another program has it"):
            Connection(url, 3, "drone 3")


def test_a_tcp_port_that_another_program_has_is_refused() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(VehicleError, match=f"tcp port {port} cannot be had"):
            Connection(f"tcpin://127.0.0.1:{port}", 3, "drone 3")


HOLDER = """
import sys
from agents.vehicles.px4.connection import Connection
connection = Connection(sys.argv[1], int(sys.argv[2]), "drone 9 of mission 'elsewhere'")
print("held", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def holder(url: str, tmp_path: Path, root_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process that has the port and vehicle 9."""
    environment = os.environ | {"TMPDIR": str(tmp_path), "PYTHONPATH": str(root_path)}
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, url, "9"],
        env=environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        yield process
        process.kill()


def test_another_processes_port_is_refused_by_its_name(holder: subprocess.Popen[str], url: str) -> None:
    with pytest.raises(VehicleError, match=f"is taken by drone 9 of mission 'elsewhere', process {holder.pid} "):
        Connection(url, 3, "drone 3")


def test_another_processes_system_is_refused_by_its_name(holder: subprocess.Popen[str], other_port: int) -> None:
    with pytest.raises(VehicleError, match=f"vehicle system 9 is taken by drone 9 .* process {holder.pid} "):
        Connection(f"udpin://127.0.0.1:{other_port}", 9, "drone 9")


def test_a_process_that_is_killed_keeps_nothing(holder: subprocess.Popen[str], url: str) -> None:
    holder.kill()
    holder.wait()

    Connection(url, 9, "drone 9").close()


def test_any_user_may_lock_and_see_who_has_it(tmp_path: Path) -> None:
    lock = MachineLock("serial port /dev/ttyACM0", "drone 1")
    (file,) = tmp_path.glob("covrecon-*")

    assert file.stat().st_mode & 0o777 == 0o666
    assert file.read_text() == f"drone 1, process {os.getpid()}"
    lock.release()
    lock.release()


def test_a_link_planted_in_the_folder_is_not_followed(tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.write_text("untouched")
    (tmp_path / "covrecon-udp port 1.lock").symlink_to(precious)

    with pytest.raises(VehicleError, match="udp port 1: cannot be locked"):
        MachineLock("udp port 1", "drone 1")
    assert precious.read_text() == "untouched"


def test_closing_twice_is_closing_once(url: str) -> None:
    connection = Connection(url, 3, "drone 3")
    connection.open()
    connection.close()
    connection.close()

    with pytest.raises(VehicleError, match="the connection is closed"):
        asyncio.run(connection.discover(1.0, time.monotonic))
