"""Whether the places at which a mission's processes want to listen are free, and if not, who has them."""

from __future__ import annotations

import errno
import re
import socket
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from deploy.doctor.finding import Finding
from deploy.run_folder import socket_folder_parent
from protocol.endpoints import internet_endpoint
from protocol.errors import ProcessError
from protocol.metrics_endpoint import HOST, metrics_port
from protocol.mission import Mission

Transport = Literal["tcp", "udp"]
LISTENING = "0A"
"""TCP's state in /proc/net/tcp."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where a process wants to listen."""

    who: str
    transport: Transport
    host: str
    port: int
    key: str
    """What to change in the mission if it is taken."""


def places(mission: Mission) -> Iterator[Place]:
    """Those of ``mission`` on this computer; none of processes that listen nowhere or anywhere that is free."""
    endpoint = internet_endpoint(mission.transport.endpoint)
    if endpoint is not None:
        protocol, host, port = endpoint
        transport: Transport = "udp" if protocol in ("udp", "quic") else "tcp"
        yield Place("router", transport, host, port, "transport.endpoint")
    if mission.console.port:
        yield Place("console", "tcp", mission.console.host, mission.console.port, "console.port")
    if mission.recording.enabled and mission.recording.foxglove_port:
        yield Place("foxglove", "tcp", HOST, mission.recording.foxglove_port, "recording.foxglove_port")
    if mission.metrics.port:
        yield Place("metrics of ground", "tcp", HOST, metrics_port(mission, "ground"), "metrics.port")
        yield Place("metrics of sim", "tcp", HOST, metrics_port(mission, "sim"), "metrics.port")
        for drone in mission.drones:
            port = metrics_port(mission, "agent", drone.id)
            yield Place(f"metrics of drone {drone.id}", "tcp", HOST, port, "metrics.port")
    if mission.vehicles.kind == "px4":
        yield from _vehicle_places(mission)


def _vehicle_places(mission: Mission) -> Iterator[Place]:
    """Where MAVSDK waits for a vehicle to call; ``udpout``, ``tcpout`` and serial lines call the vehicle."""
    for drone in mission.drones:
        found = re.fullmatch(r"(udp|udpin|tcpin)://([^:]*):(\d+)", mission.vehicle_url(drone))
        if found:
            transport: Transport = "tcp" if found[1] == "tcpin" else "udp"
            host = found[2] or "0.0.0.0"  # noqa: S104  # what MAVSDK takes an empty host for
            yield Place(f"PX4 of drone {drone.id}", transport, host, int(found[3]), "vehicles.url")


def check_socket_folder() -> Finding:
    """Where the private socket of a mission without an endpoint would be."""
    try:
        return Finding("socket", "ok", f"private ones can be made in {socket_folder_parent()}")
    except ProcessError as error:
        return Finding("socket", "fail", str(error), "set XDG_RUNTIME_DIR to a folder of yours with a short path")


def check_place(place: Place) -> Finding:
    """Listen there for a moment."""
    subject = f"port {place.port}"
    where = f"{place.who}: {place.transport} {place.host}:{place.port}"
    try:
        _listen(place)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            owner = owner_of(place.transport, place.port)
            advice = f"end it if it is left over, or set {place.key} to another port"
            return Finding(subject, "fail", f"{where} is taken{f' by {owner}' if owner else ''}", advice)
        if error.errno == errno.EACCES:
            return Finding(
                subject, "fail", f"{where} is for the administrator", f"set {place.key} to a port above 1023"
            )
        advice = f"set {place.key} to an address of this computer, or start that process where the address is"
        return Finding(subject, "fail", f"{where}: {error.strerror or error}", advice)
    except OverflowError:
        return Finding(subject, "fail", f"{where} is beyond the last port, 65535", f"choose a smaller {place.key}")
    return Finding(subject, "ok", f"{where} is free")


def _listen(place: Place) -> None:
    kind = socket.SOCK_STREAM if place.transport == "tcp" else socket.SOCK_DGRAM
    family, _, _, _, address = socket.getaddrinfo(place.host, None, type=kind)[0]
    with socket.socket(family, kind) as probe:
        if place.transport == "tcp":  # or a connection that was closed a minute ago would count; udp would share
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind((address[0], place.port))
        if place.transport == "tcp":
            probe.listen(1)


def owner_of(transport: Transport, port: int, proc: Path = Path("/proc")) -> str:
    """Process that listens at ``port``, as far as this user may know; empty otherwise."""
    sockets = {f"socket:[{inode}]" for inode in _inodes(transport, port, proc)}
    for process in proc.glob("[0-9]*"):
        with suppress(OSError):  # another user's, or one that has just ended
            if any(str(link.readlink()) in sockets for link in (process / "fd").iterdir()):
                words = (process / "cmdline").read_bytes().decode(errors="replace").split("\0")
                return f"process {process.name} ({' '.join(words).strip()[:120]})"
    return ""


def _inodes(transport: Transport, port: int, proc: Path) -> Iterator[str]:
    for name in (transport, f"{transport}6"):
        with suppress(FileNotFoundError):
            for line in (proc / "net" / name).read_text().splitlines()[1:]:
                columns = line.split()
                local, state, inode = columns[1], columns[3], columns[9]
                if int(local.rpartition(":")[2], 16) == port and (transport == "udp" or state == LISTENING):
                    yield inode
