"""A UDP link between one zenoh client and the router that loses, delays and repeats datagrams.

zenoh resends nothing on UDP, throws late datagrams away and suppresses repeated ones (measured: of 500 messages 5 %
loss took 24, 10 % late by 5 to 60 ms took 43, repetition took none, none came out of order, and no session ended), so
messages are lost as on a radio without retransmission. What it loses of a connection's beginning it never says again:
links are made lossy after everybody is connected.
"""

from __future__ import annotations

import asyncio
import random
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import cast

Address = tuple[str, int]


@dataclass(frozen=True)
class Loss:
    """Probabilities are per datagram, in both directions."""

    lost: float = 0.0
    late: float = 0.0
    late_s: tuple[float, float] = (0.005, 0.06)
    """Range of the delay of late datagrams: the others overtake them."""
    repeated: float = 0.0


class DatagramLink(asyncio.DatagramProtocol):
    """One client's way to the router; ``endpoint`` is what the client connects to."""

    def __init__(self, router: Address, seed: int) -> None:
        self._router = router
        self._random = random.Random(seed)
        self._ways: dict[Address, _Way] = {}
        self._loss = Loss()
        self.endpoint = ""
        self.passed = 0
        self.lost = 0

    def set(self, loss: Loss) -> None:
        self._loss = loss

    def heal(self) -> None:
        self._loss = Loss()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.DatagramTransport", transport)  # in Python 3.11 it is no subclass of it
        self.endpoint = f"udp/127.0.0.1:{transport.get_extra_info('sockname')[1]}"

    def datagram_received(self, data: bytes, client: Address) -> None:
        way = self._ways.get(client)
        if way is None:
            way = self._ways[client] = _Way(self, lambda answer: self._transport.sendto(answer, client))
            way.opening = asyncio.ensure_future(way.open(self._router))
        self.forward(way.send, data)

    def forward(self, send: Callable[[bytes], None], data: bytes) -> None:
        if self._random.random() < self._loss.lost:
            self.lost += 1
            return
        self.passed += 1
        for _ in range(2 if self._random.random() < self._loss.repeated else 1):
            if self._random.random() < self._loss.late:
                asyncio.get_running_loop().call_later(self._random.uniform(*self._loss.late_s), send, data)
            else:
                send(data)

    def close(self) -> None:
        self._transport.close()
        for way in self._ways.values():
            way.close()


class _Way(asyncio.DatagramProtocol):
    """The router's side of one client: a socket of its own, by which the router tells the clients apart."""

    def __init__(self, link: DatagramLink, answer: Callable[[bytes], None]) -> None:
        self._link, self._answer = link, answer
        self._transport: asyncio.DatagramTransport | None = None
        self._early: list[bytes] = []
        self.opening: asyncio.Future[None] | None = None

    async def open(self, router: Address) -> None:
        self._transport, _ = await asyncio.get_running_loop().create_datagram_endpoint(lambda: self, remote_addr=router)
        for data in self._early:
            self._transport.sendto(data)

    def send(self, data: bytes) -> None:
        if self._transport is None:
            self._early.append(data)
        elif not self._transport.is_closing():
            self._transport.sendto(data)

    def datagram_received(self, data: bytes, _: Address) -> None:
        self._link.forward(self._reply, data)

    def _reply(self, data: bytes) -> None:
        if self._transport is not None and not self._transport.is_closing():
            self._answer(data)

    def error_received(self, _: Exception) -> None:
        """The router is not there: as good as lost."""
        self._link.lost += 1

    def close(self) -> None:
        if self.opening is not None:
            self.opening.cancel()
        if self._transport is not None:
            self._transport.close()


@asynccontextmanager
async def datagram_link(router_port: int, seed: int = 0) -> AsyncIterator[DatagramLink]:
    """A healthy link to the router that listens at ``router_port`` of this machine, then or later."""
    _, made = await asyncio.get_running_loop().create_datagram_endpoint(
        lambda: DatagramLink(("127.0.0.1", router_port), seed), local_addr=("127.0.0.1", 0)
    )
    try:
        yield made
    finally:
        made.close()
