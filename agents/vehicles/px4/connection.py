"""The link to exactly one vehicle: its port and its system belong to this process alone, or there is no link."""

from __future__ import annotations

import asyncio
import logging
import re
import socket
from collections.abc import Callable
from dataclasses import dataclass

from mavsdk import Configuration, Mavsdk, System, log_subscribe

from agents.vehicles.px4.locks import MachineLock
from agents.vehicles.px4.refusals import refusals
from protocol.errors import VehicleError

log = logging.getLogger("mavsdk")

OWN_SYSTEM_ID, OWN_COMPONENT_ID = 245, 190
"""A ground station's, MAV_COMP_ID_MISSIONPLANNER. MAVSDK's companion computer would take system id 1, a vehicle's."""
POLL_S = 0.1
ALONE_S = 1.5
"""After the vehicle was heard, others on the same link get so long to be heard too; heartbeats come once a second."""
LOG_LEVELS = (logging.DEBUG, logging.INFO, logging.WARNING, logging.ERROR)
"""Of MAVSDK's levels 0 to 3."""

NETWORK_URL = re.compile(r"(?P<scheme>udpin|udpout|tcpin|tcpout)://(?P<host>[^:/]*):(?P<port>\d{1,5})")
SERIAL_URL = re.compile(r"serial(_flowcontrol)?://(?P<device>/[^:]+)(:\d+)?")


@dataclass(frozen=True, slots=True)
class Endpoint:
    """What a URL occupies on this machine."""

    key: str
    """The name of its lock."""
    bind: tuple[str, int, socket.SocketKind] | None = None
    """Host, port and kind of the socket that will be bound; None where nothing is."""


def endpoint_of(url: str) -> Endpoint:
    """Raises: VehicleError: no URL that MAVSDK can connect to."""
    if serial := SERIAL_URL.fullmatch(url):
        return Endpoint(f"serial port {serial['device']}")
    match = NETWORK_URL.fullmatch(url)
    if match is None or not 0 < int(match["port"]) < 1 << 16:
        raise VehicleError(
            f"{url!r} is no connection: udpin://127.0.0.1:14540, udpout://, tcpin:// or tcpout:// with host and port,"
            " or serial:///dev/ttyACM0:57600"
        )
    transport, direction = match["scheme"][:3], match["scheme"][3:]
    host, port = match["host"] or "0.0.0.0", int(match["port"])  # noqa: S104  # what MAVSDK makes of no host
    if direction == "out":
        return Endpoint(f"{transport} link to {host}:{port}")
    kind = socket.SOCK_DGRAM if transport == "udp" else socket.SOCK_STREAM
    return Endpoint(f"{transport} port {port}", (host, port, kind))


def _refuse_bound(endpoint: Endpoint) -> None:
    """The lock keeps our own processes apart; this finds a ground station or a router that has the port."""
    if endpoint.bind is None:
        return
    host, port, kind = endpoint.bind
    with socket.socket(socket.AF_INET, kind) as probe:
        if kind == socket.SOCK_STREAM:  # else a port is refused for a minute after its last connection was closed
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
            if kind == socket.SOCK_STREAM:
                probe.listen()
        except OSError as error:
            raise VehicleError(f"{endpoint.key} cannot be had, perhaps another program has it: {error}") from error


def _swallow(level: int, message: str, _file: str | None, _line: int) -> bool:
    log.log(LOG_LEVELS[level], "%s", message)
    return True  # nothing on stdout


class Connection:
    """Locks, `Mavsdk` and the one `System`; closed by `close`, from any thread, as often as one likes."""

    def __init__(self, url: str, system_id: int, owner: str) -> None:
        """Takes port and system. ``system_id``: the vehicle's; ``owner``: who we are, for those who find them taken.

        Raises:
            VehicleError: the URL is none, or port or system is taken.
        """
        self._url, self._system_id = url, system_id
        endpoint = endpoint_of(url)
        self._locks: list[MachineLock] = []
        self._sdk: Mavsdk | None = None
        try:
            for what in (endpoint.key, f"vehicle system {system_id}"):
                self._locks.append(MachineLock(what, owner))
            _refuse_bound(endpoint)
        except VehicleError:
            self.close()
            raise

    def open(self) -> None:
        """Once; may block.

        Raises:
            VehicleError: MAVSDK cannot connect.
        """
        log_subscribe(_swallow)
        with refusals(f"connecting to {self._url}"):
            self._sdk = Mavsdk(Configuration.create_manual(OWN_SYSTEM_ID, OWN_COMPONENT_ID, True))
            self._sdk.add_any_connection_with_handle(self._url)

    async def discover(self, timeout_s: float, now_s: Callable[[], float]) -> System:
        """The vehicle, once it is heard and nobody else is.

        Raises:
            VehicleError: nobody was heard in time, or somebody else was.
        """
        deadline_s = now_s() + timeout_s
        heard_s: float | None = None
        while True:
            systems = self._autopilots()
            others = sorted(set(systems) - {self._system_id})
            if others:
                heard = ", ".join(map(str, others))
                raise VehicleError(f"{self._url}: system {heard} is heard, where {self._system_id} is expected, alone")
            if systems and heard_s is None:
                heard_s = now_s()
            if heard_s is not None and now_s() - heard_s >= ALONE_S:
                return systems[self._system_id]
            if heard_s is None and now_s() > deadline_s:
                raise VehicleError(
                    f"{self._url}: no vehicle was heard for {timeout_s:g} s;"
                    " does it run and send there? docs/px4.md, or fly without one: --vehicles px4-endpoint"
                )
            await asyncio.sleep(POLL_S)

    def _autopilots(self) -> dict[int, System]:
        if self._sdk is None:
            raise VehicleError(f"{self._url}: the connection is closed")
        with refusals(f"listening on {self._url}"):
            return {system.get_system_id(): system for system in self._sdk.get_systems() if system.has_autopilot()}

    def close(self) -> None:
        sdk, self._sdk = self._sdk, None
        if sdk is not None:
            sdk.destroy()
        for lock in self._locks:
            lock.release()
