"""Hosts in network namespaces: what their links do to real packets, and that nothing of them stays behind."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from faults.hosts import NAMESPACES, Hosts, reason_against_hosts
from faults.radio import WIRE, Shape

PATIENCE_S = 10.0
HEADER_BYTES = 28
"""Of a UDP packet: IP's and its own."""
ROUND_TRIP_S = 0.06
TRIPS = 40
EXTRA_S = 0.002
"""What may be added to a round trip, in the middle and by its spread."""
FLOOD_BYTES = 1_500_000
"""Takes 2.4 s at 5 Mbit/s."""

pytestmark = [pytest.mark.processes, pytest.mark.light]
against = reason_against_hosts()
needs_hosts = pytest.mark.skipif(against is not None, reason=str(against))


@pytest.fixture
def hosts() -> Iterator[Hosts]:
    with Hosts({"ground": WIRE, "drone-1": Shape(), "drone-2": Shape()}) as made:
        yield made


@pytest.fixture
def ground(hosts: Hosts) -> Iterator[socket.socket]:
    with udp(hosts, "ground") as made:
        yield made


@pytest.fixture
def drone(hosts: Hosts) -> Iterator[socket.socket]:
    with udp(hosts, "drone-1") as made:
        yield made


def udp(hosts: Hosts, host: str) -> socket.socket:
    made = hosts.socket(host, socket.SOCK_DGRAM)
    made.settimeout(PATIENCE_S)
    return made


def round_trip_s(one: socket.socket, other: socket.socket) -> float:
    began = time.perf_counter()
    one.sendto(b"there", other.getsockname())
    assert other.recv(100) == b"there"
    other.sendto(b"and back", one.getsockname())
    assert one.recv(100) == b"and back"
    return time.perf_counter() - began


@needs_hosts
def test_a_round_trip_takes_both_delays_and_hardly_more(drone: socket.socket, ground: socket.socket) -> None:
    trips = [round_trip_s(drone, ground) for _ in range(TRIPS)]

    # The fastest: others waited for a processor, too. `figures` tells how late packets were passed on.
    assert ROUND_TRIP_S <= min(trips) <= ROUND_TRIP_S + EXTRA_S


@needs_hosts
def test_drones_reach_each_other_over_both_their_links(hosts: Hosts, drone: socket.socket) -> None:
    with udp(hosts, "drone-2") as other:
        fastest_s = min(round_trip_s(drone, other) for _ in range(TRIPS))

    assert 2 * ROUND_TRIP_S <= fastest_s <= 2 * ROUND_TRIP_S + 2 * EXTRA_S


@needs_hosts
@pytest.mark.parametrize(("sender", "receiver"), [("drone-1", "ground"), ("ground", "drone-1")])
def test_a_flood_passes_at_the_link_s_rate(hosts: Hosts, sender: str, receiver: str) -> None:
    with hosts.socket(receiver, socket.SOCK_STREAM) as listener, hosts.socket(sender, socket.SOCK_STREAM) as source:
        listener.listen()
        source.settimeout(PATIENCE_S)
        source.connect(listener.getsockname())
        sink, _ = listener.accept()
        flood = threading.Thread(target=source.sendall, args=(bytes(FLOOD_BYTES),))
        with sink:
            sink.settimeout(PATIENCE_S)
            flood.start()
            received, began, counted = len(sink.recv(1 << 16)), time.perf_counter(), arrived(hosts, receiver)
            while received < FLOOD_BYTES:
                received += len(sink.recv(1 << 16))
            rate_bps = 8 * (arrived(hosts, receiver) - counted) / (time.perf_counter() - began)
            flood.join()

    assert rate_bps == pytest.approx(5e6, rel=0.1)


def arrived(hosts: Hosts, host: str) -> int:
    return hosts.bytes_down(host)


@needs_hosts
def test_a_cut_link_loses_packets_without_a_word_and_heals(
    hosts: Hosts, drone: socket.socket, ground: socket.socket
) -> None:
    round_trip_s(drone, ground)

    hosts.cut("drone-1")
    drone.sendto(b"lost", ground.getsockname())
    ground.sendto(b"lost", drone.getsockname())
    ground.settimeout(0.2)
    with pytest.raises(TimeoutError):
        ground.recv(100)
    ground.settimeout(PATIENCE_S)
    hosts.heal("drone-1")

    assert round_trip_s(drone, ground) >= ROUND_TRIP_S, "and nothing of before arrives"
    ways = hosts.figures()["ways"]
    assert ways["drone-1 up"] == {"passed": 2, "dropped": 0, "lost": 1}
    assert ways["drone-1 down"] == {"passed": 2, "dropped": 0, "lost": 1}


@needs_hosts
def test_interfaces_count_the_bytes_of_ip_packets(hosts: Hosts, drone: socket.socket, ground: socket.socket) -> None:
    before = {host: (hosts.bytes_up(host), hosts.bytes_down(host)) for host in ("drone-1", "drone-2")}
    for _ in range(10):
        drone.sendto(bytes(1000), ground.getsockname())
        ground.recv(2000)
    ground.sendto(bytes(500), drone.getsockname())
    drone.recv(2000)

    assert hosts.bytes_up("drone-1") - before["drone-1"][0] == 10 * (1000 + HEADER_BYTES)
    assert hosts.bytes_down("drone-1") - before["drone-1"][1] == 500 + HEADER_BYTES
    assert (hosts.bytes_up("drone-2"), hosts.bytes_down("drone-2")) == before["drone-2"]


@needs_hosts
def test_a_process_in_a_host_sees_that_host_alone_and_goes_with_it(tmp_path: Path) -> None:
    look = "import socket, time; print(socket.if_nameindex(), flush=True); time.sleep(600)"
    with Hosts({"ground": WIRE}) as hosts:
        process = hosts.start("ground", sys.executable, "-c", look, log=tmp_path / "log")
        deadline = time.monotonic() + PATIENCE_S
        while "\n" not in (tmp_path / "log").read_text():
            assert time.monotonic() < deadline
        assert process.poll() is None
        namespace = hosts.namespace("ground")
        assert namespace.exists()

    assert (tmp_path / "log").read_text().strip() == "[(1, 'lo'), (2, 'air')]"
    assert process.poll() == -9
    assert not namespace.exists()


@needs_hosts
def test_what_a_killed_run_has_left_is_removed_by_the_next() -> None:
    code = """if True:
        import os, signal, sys
        from faults.hosts import Hosts
        from faults.radio import WIRE
        with Hosts({"ground": WIRE}) as hosts:
            print(hosts.namespace("ground"), flush=True)
            os.kill(os.getpid(), signal.SIGKILL)
    """
    killed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=with_path(), check=False)
    left = Path(killed.stdout.strip())
    assert killed.returncode == -9
    assert left.parent == NAMESPACES
    assert left.exists()

    with Hosts({"ground": WIRE}):
        assert not left.exists()


def with_path() -> dict[str, str]:
    return os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}


def test_who_has_no_iproute2_is_told_what_to_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))

    assert "apt-get install iproute2" in str(reason_against_hosts())


def test_who_may_not_make_namespaces_is_told_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("ip", "nsenter"):
        (tmp_path / name).write_text(
            "#!/bin/sh\necho 'mount --make-shared /run/netns failed: not permitted' >&2\nexit 1\n"
        )
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))

    reason = str(reason_against_hosts())

    assert reason.startswith("network namespaces cannot be made")
    assert "not permitted" in reason
