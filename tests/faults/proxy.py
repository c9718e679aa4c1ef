"""A TCP link between one zenoh client and the router that can be made slow, narrow, dead or cut while it is used.

Bytes are never lost or changed: that is what TCP promises the processes. A dead link holds them, as a radio out of
range does, and delivers them when it heals; whoever gave up in between opens a new connection, which the dead link
accepts and leaves without an answer.
"""

from __future__ import annotations

import asyncio
import random
import socket
import struct
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Literal

CHUNK_BYTES = 16 * 1024
BUFFER_BYTES = 64 * 1024
"""Of each socket, and of what is under way: a link that holds megabytes would hide that nothing gets through."""
SLICES_PER_S = 50
"""A narrow link passes its bytes on in so many portions a second."""

Direction = Literal["up", "down"]
"""From the client to the router, and back."""


@dataclass
class Fault:
    """What a link does to what passes through it; read anew for each chunk."""

    delay_s: float = 0.0
    jitter_s: float = 0.0
    """Added to the delay, uniformly; order is kept."""
    bytes_per_s: float = float("inf")
    """Of each direction, ..."""
    narrow: tuple[Direction, ...] = ("up", "down")
    """... of these."""
    held: tuple[Direction, ...] = ()
    """Directions in which nothing passes."""


@dataclass
class Link:
    """One client's way to the router; ``endpoint`` is what the client connects to."""

    endpoint: str
    _target: tuple[str, int]
    _random: random.Random
    _fault: Fault = field(default_factory=Fault)
    _changed: asyncio.Event = field(default_factory=asyncio.Event)
    _writers: set[asyncio.StreamWriter] = field(default_factory=set)
    _serving: set[asyncio.Task[None]] = field(default_factory=set)
    connections: int = 0
    """Accepted so far."""
    passed_bytes: int = 0
    """In both directions."""

    def set(self, fault: Fault) -> None:
        self._fault = fault
        self._changed.set()
        self._changed = asyncio.Event()

    def heal(self) -> None:
        self.set(Fault())

    def reset(self) -> None:
        """Cut all connections with RST instead of an orderly end; new ones are served."""
        for writer in list(self._writers):
            _abort(writer)

    # --- passing on ----------------------------------------------------------------------------------------------

    def accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        task = asyncio.create_task(self._serve(reader, writer))
        self._serving.add(task)
        task.add_done_callback(self._serving.discard)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writers.add(writer)
        try:
            await self._until_passing("up")
            onwards, backwards = await _open(self._target)
            self._writers.add(backwards)
            try:
                async with asyncio.TaskGroup() as group:
                    group.create_task(self._pump(reader, backwards, "up"))
                    group.create_task(self._pump(onwards, writer, "down"))
            finally:
                self._cut(backwards)
        except* OSError:
            pass  # the router is down, or one side was cut: so is the other now
        finally:
            self._cut(writer)

    def _cut(self, writer: asyncio.StreamWriter) -> None:
        _abort(writer)
        self._writers.discard(writer)

    async def _pump(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, direction: Direction) -> None:
        """Pass bytes on until the reader's side ends, or either is cut."""
        loop = asyncio.get_running_loop()
        flying: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue()
        under_way = 0
        room = asyncio.Event()

        async def take_in() -> None:
            nonlocal under_way
            while True:
                await self._until_passing(direction)
                while under_way >= BUFFER_BYTES:
                    room.clear()
                    await room.wait()
                chunk = await reader.read(CHUNK_BYTES)
                late_s = self._fault.delay_s + self._fault.jitter_s * self._random.random()
                under_way += len(chunk)
                flying.put_nowait((loop.time() + late_s, chunk))
                if not chunk:
                    return

        async def pass_on() -> None:
            nonlocal under_way
            while True:
                due, chunk = await flying.get()
                await asyncio.sleep(due - loop.time())
                await self._until_passing(direction)
                if not chunk:
                    writer.write_eof()
                    return
                await self._write(writer, chunk, direction)
                under_way -= len(chunk)
                room.set()

        async with asyncio.TaskGroup() as group:
            group.create_task(take_in())
            group.create_task(pass_on())

    async def _write(self, writer: asyncio.StreamWriter, chunk: bytes, direction: Direction) -> None:
        start = 0
        while start < len(chunk):
            rate = self._fault.bytes_per_s if direction in self._fault.narrow else float("inf")
            portion = len(chunk) if rate == float("inf") else max(1, int(rate / SLICES_PER_S))
            writer.write(chunk[start : start + portion])
            await writer.drain()
            self.passed_bytes += len(chunk[start : start + portion])
            start += portion
            if rate != float("inf"):
                await asyncio.sleep(min(portion, len(chunk)) / rate)

    async def _until_passing(self, direction: Direction) -> None:
        while direction in self._fault.held:
            await self._changed.wait()

    async def close(self) -> None:
        for task in list(self._serving):
            task.cancel()
        await asyncio.gather(*self._serving, return_exceptions=True)


@asynccontextmanager
async def link(router_port: int, seed: int = 0) -> AsyncIterator[Link]:
    """A healthy link to the router that listens at ``router_port`` of this machine, then or later."""
    listener = socket.socket(socket.AF_INET)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
    listener.bind(("127.0.0.1", 0))
    made = Link(f"tcp/127.0.0.1:{listener.getsockname()[1]}", ("127.0.0.1", router_port), random.Random(seed))
    server = await asyncio.start_server(made.accept, sock=listener, limit=CHUNK_BYTES)
    try:
        yield made
    finally:
        server.close()
        await made.close()


async def _open(target: tuple[str, int]) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    outgoing = socket.socket(socket.AF_INET)
    outgoing.setblocking(False)
    outgoing.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
    try:
        await asyncio.get_running_loop().sock_connect(outgoing, target)
    except BaseException:
        outgoing.close()
        raise
    return await asyncio.open_connection(sock=outgoing, limit=CHUNK_BYTES)


def _abort(writer: asyncio.StreamWriter) -> None:
    """End a connection at once, with RST."""
    opened = writer.get_extra_info("socket")
    if opened is not None and opened.fileno() >= 0:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    writer.transport.abort()
