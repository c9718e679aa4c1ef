"""One direction of one process's way to the router, and all that can be wrong with it."""

from __future__ import annotations

import asyncio
import math
import random
from collections import Counter, deque
from collections.abc import Callable
from contextvars import Context
from dataclasses import dataclass

FASTEST_S, SLOWEST_S = 0.0002, 0.002
"""Latency of a link that nothing is wrong with, drawn for every message (measured: 0.4 to 2 ms)."""
ONE_AFTER_ANOTHER_S = 1e-9
"""Between two messages in order: timers that are due at the same time fire in no particular one."""
BUFFER_BYTES = 128 * 1024
"""What waits in both sockets and zenoh's queues for a link that is slow or dead; then messages are dropped."""


@dataclass(frozen=True, slots=True)
class Faults:
    """What a link does to messages; probabilities are per message."""

    loss: float = 0.0
    duplicate: float = 0.0
    garble: float = 0.0
    """Probability that a message's bytes become rubbish."""
    delay_s: float = 0.0
    jitter_s: float = 0.0
    """Up to so much more delay, drawn for every message: they overtake each other."""
    bytes_per_s: float = math.inf
    black_hole: bool = False
    """Nothing gets through; what fits the buffers comes when it ends, unless the lease has run out by then."""


@dataclass(frozen=True, slots=True)
class _Packet:
    key: str
    payload: bytes
    arrive: Callable[[bytes], None]
    safe: bool


class Link:
    """In order while there is no jitter. What is ``safe`` (declarations, lockstep) may be late but is never lost."""

    def __init__(self, dice: random.Random, garble: Callable[[str, bytes], bytes], counts: Counter[str]) -> None:
        self._faults = Faults()
        self._dice, self._garble, self._counts = dice, garble, counts
        self._waiting: deque[_Packet] = deque()
        self._waiting_bytes = 0
        self._busy = False
        self._newest_s = 0.0
        self._connection = 0

    @property
    def faults(self) -> Faults:
        return self._faults

    @faults.setter
    def faults(self, faults: Faults) -> None:
        """What waited for the old ones to end goes on its way."""
        self._faults = faults
        self._pump()

    def send(self, key: str, payload: bytes, arrive: Callable[[bytes], None], *, safe: bool) -> None:
        """Call ``arrive`` with what is left of ``payload``, some time later, once, twice or never."""
        slow = self._faults.black_hole or not math.isinf(self._faults.bytes_per_s)  # else the buffers empty at once
        if not safe and slow and self._waiting_bytes + len(payload) > BUFFER_BYTES:
            self._counts["no room"] += 1
            return
        self._waiting.append(_Packet(key, payload, arrive, safe))
        self._waiting_bytes += len(payload)
        self._pump()

    def _pump(self) -> None:
        """Pass on what waits, as fast as the link is."""
        while self._waiting and not self._busy and not self._faults.black_hole:
            packet = self._waiting.popleft()
            self._waiting_bytes -= len(packet.payload)
            if math.isinf(self._faults.bytes_per_s):
                self._pass_on(packet)
            else:
                self._busy = True
                self._at(_now_s() + len(packet.payload) / self._faults.bytes_per_s, self._passed, packet)

    def _passed(self, packet: _Packet) -> None:
        self._busy = False
        self._pass_on(packet)
        self._pump()

    def _pass_on(self, packet: _Packet) -> None:
        faults, payload = self._faults, packet.payload
        due_s = _now_s() + faults.delay_s + self._dice.uniform(FASTEST_S, SLOWEST_S)
        if packet.safe:
            self._post(max(due_s, self._newest_s + ONE_AFTER_ANOTHER_S), packet.arrive, payload)
            return
        if self._happens("lost", faults.loss):
            return
        if self._happens("garbled", faults.garble):
            payload = self._garble(packet.key, payload)
        for _ in range(2 if self._happens("duplicated", faults.duplicate) else 1):
            if faults.jitter_s:
                late_s = due_s + self._dice.uniform(0.0, faults.jitter_s)
                self._counts["overtaken"] += late_s < self._newest_s
            else:
                late_s = max(due_s, self._newest_s + ONE_AFTER_ANOTHER_S)
            self._post(late_s, packet.arrive, payload)

    def _happens(self, what: str, probability: float) -> bool:
        if not probability or self._dice.random() >= probability:
            return False
        self._counts[what] += 1
        return True

    def _post(self, due_s: float, arrive: Callable[[bytes], None], payload: bytes) -> None:
        self._newest_s = max(self._newest_s, due_s)
        self._at(due_s, arrive, payload)

    def _at(self, due_s: float, action: Callable[..., None], *arguments: object) -> None:
        """As nobody's: what is under way arrives even if its sender is stopped or killed."""

        def act(connection: int) -> None:
            if connection == self._connection:
                action(*arguments)

        asyncio.get_running_loop().call_at(due_s, act, self._connection, context=Context())

    def cut(self) -> None:
        """The connection is gone, and with it all that was under way."""
        self._connection += 1
        self._counts["cut off"] += len(self._waiting)
        self._waiting.clear()
        self._waiting_bytes = 0
        self._busy = False


def _now_s() -> float:
    return asyncio.get_running_loop().time()
