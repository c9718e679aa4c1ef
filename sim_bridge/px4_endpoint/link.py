"""A vehicle's UDP socket: MAVLink messages out to where MAVSDK listens, and in from there."""

from __future__ import annotations

import contextlib
import re
import socket

from protocol.errors import MissionError
from sim_bridge.px4_endpoint.dialect import Packet, mavlink

COMPONENT: int = mavlink.MAV_COMP_ID_AUTOPILOT1
DATAGRAM_MAX = 65535


class Link:
    """Sends to the address of a ``udpin://`` connection, from a port of its own.

    Raises:
        MissionError: ``url`` is another kind of connection.
    """

    def __init__(self, url: str, system: int) -> None:
        match = re.fullmatch(r"udpin://([^:]*):(\d+)", url)
        if match is None:
            raise MissionError([f"vehicles.url: the endpoint sends to udpin://HOST:PORT only, not to {url}"])
        host = match[1] if match[1] not in ("", "0.0.0.0") else "127.0.0.1"  # noqa: S104  # an address to replace, not to bind
        self.url = url
        self.system = system
        self.silent = False
        """Nothing is sent."""
        self.deaf = False
        """Nothing is received."""
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        self.socket.connect((host, int(match[2])))
        self._codec = mavlink.MAVLink(None, system, COMPONENT)
        self._codec.robust_parsing = True

    def send(self, packet: Packet) -> None:
        """Dropped when nobody listens, as on the air."""
        if self.silent:
            return
        datagram = packet.pack(self._codec)
        self._codec.seq = (self._codec.seq + 1) % 256
        with contextlib.suppress(BlockingIOError, ConnectionRefusedError):
            self.socket.send(datagram)

    def receive(self) -> list[Packet]:
        """All that has come in for this vehicle."""
        packets: list[Packet] = []
        while True:
            try:
                datagram = self.socket.recv(DATAGRAM_MAX)
            except BlockingIOError:
                return packets
            except ConnectionRefusedError:  # of an earlier send
                continue
            if not self.deaf:
                packets += [p for p in self._codec.parse_buffer(datagram) or () if self._is_for_us(p)]

    def _is_for_us(self, packet: Packet) -> bool:
        if packet.get_type() == "BAD_DATA":
            return False
        return getattr(packet, "target_system", 0) in (0, self.system)

    def close(self) -> None:
        self.socket.close()
