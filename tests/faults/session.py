"""What a process holds of the fake network: as much of a `zenoh.Session` as `protocol.bus.Bus` uses."""

from __future__ import annotations

import asyncio
import functools
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import zenoh

from faults.link import BUFFER_BYTES, Link
from faults.virtual_loop import Process

if TYPE_CHECKING:
    from faults.network import Network


@functools.cache
def meet(one: str, other: str) -> bool:
    return bool(zenoh.KeyExpr(one).intersects(zenoh.KeyExpr(other)))


class Ring:
    """Stands in for `zenoh.handlers.RingChannel`, which does not tell its capacity."""

    def __init__(self, capacity: int) -> None:
        self._samples: deque[Sample] = deque(maxlen=capacity)

    def put(self, sample: Sample) -> None:
        self._samples.append(sample)

    def try_recv(self) -> Sample | None:
        return self._samples.popleft() if self._samples else None


@dataclass(frozen=True, slots=True)
class Payload:
    content: bytes

    def to_bytes(self) -> bytes:
        return self.content

    def __len__(self) -> int:
        return len(self.content)


@dataclass(frozen=True, slots=True)
class Sample:
    key_expr: str
    payload: Payload
    kind: zenoh.SampleKind


@dataclass(frozen=True, slots=True)
class Reply:
    ok: Sample | None
    """None: an error, or the time-out."""


@dataclass(slots=True)
class Question:
    """A query under way: who asked, and whose last word is still awaited."""

    asker: Session
    callback: Callable[[Reply], None]
    drop: Callable[[], None]
    awaited: set[Session] = field(default_factory=set)
    over: bool = False


class Query:
    """What a server sees of a question; what it replies travels when it drops the query."""

    def __init__(self, server: Session, question: Question, parameters: str) -> None:
        self._server, self._question = server, question
        self._replies: list[tuple[str, bytes]] = []
        self._dropped = False
        self.parameters = parameters

    def reply(self, key: str, payload: bytes) -> None:
        self._replies.append((key, payload))

    def reply_err(self, payload: bytes) -> None:
        del payload  # the asker makes nothing of it

    def drop(self) -> None:
        if not self._dropped:
            self._dropped = True
            self._server.answer(self._question, self._replies)


class _Subscriber:
    def __init__(self, session: Session, key: str, handler: Ring | Callable[[Sample], None]) -> None:
        self._session, self._ring = session, handler if isinstance(handler, Ring) else None
        self._entry = (key, handler.put if isinstance(handler, Ring) else handler)
        session.subscribers.append(self._entry)

    def try_recv(self) -> Sample | None:
        assert self._ring is not None
        return self._ring.try_recv()

    def undeclare(self) -> None:
        self._session.subscribers.remove(self._entry)


class _Publisher:
    def __init__(self, session: Session, key: str, *, safe: bool) -> None:
        self._session, self._key, self._safe = session, key, safe

    def put(self, payload: bytes) -> None:
        self._session.put(self._key, payload, safe=self._safe)


class _Liveliness:
    def __init__(self, session: Session) -> None:
        self._session = session

    def declare_token(self, key: str) -> object:
        self._session.require_open()
        self._session.tokens.append(key)
        self._session.tell_router(lambda: self._session.network.declare_alive(self._session, key))
        return key

    def declare_subscriber(self, key: str, callback: Callable[[Sample], None], *, history: bool) -> object:
        assert history, "the Bus wants to know who was there before"
        self._session.require_open()
        self._session.watchers.append((key, callback))
        self._session.tell_router(lambda: self._session.network.tell_lives(self._session))
        return callback


class Session:
    """One process's zenoh session; a `zenoh.Session` as far as the Bus can tell."""

    def __init__(self, network: Network, process: Process) -> None:
        self.network, self.process = network, process
        self.connected = True
        self.closed = False
        self.up = Link(network.dice, network.garble, network.counts)
        self.down = Link(network.dice, network.garble, network.counts)
        self.tokens: list[str] = []
        self.watchers: list[tuple[str, Callable[[Sample], None]]] = []
        self.queryables: list[tuple[str, Callable[[Query], None]]] = []
        self.questions: list[Question] = []
        self.seen: dict[str, None] = {}
        """Tokens that this process believes to be alive, in order."""
        self.hears: Callable[[str, bytes], bytes] | None = None
        """Changes what it hears: a wrong clock, for instance."""
        self.subscribers: list[tuple[str, Callable[[Sample], None]]] = []
        self.changes = 0
        """Of its connection so far; a timer that was set before the last one is void."""
        self._piled_bytes = 0

    # --- what the Bus calls --------------------------------------------------------------------------------------

    def declare_publisher(
        self,
        key: str,
        *,
        congestion_control: zenoh.CongestionControl,
        priority: zenoh.Priority,
        express: bool,
    ) -> _Publisher:
        del priority, express  # all share one queue: harsher than zenoh
        self.require_open()
        return _Publisher(self, key, safe=congestion_control == zenoh.CongestionControl.BLOCK)

    def declare_subscriber(
        self, key: str, handler: Ring | Callable[[Sample], None], *, allowed_origin: zenoh.Locality
    ) -> _Subscriber:
        assert allowed_origin == zenoh.Locality.REMOTE, "a process never hears itself"
        self.require_open()
        return _Subscriber(self, key, handler)

    def declare_queryable(self, key: str, callback: Callable[[Query], None]) -> object:
        self.require_open()
        self.queryables.append((key, callback))
        return callback

    def liveliness(self) -> _Liveliness:
        return _Liveliness(self)

    def get(self, selector: str, handler: Any, *, timeout: float, **_quality_of_service: object) -> None:
        """``handler`` is a `zenoh.handlers.Callback`; its drop ends the question."""
        self.require_open()
        question = Question(self, handler.callback, handler.drop)
        self.questions.append(question)
        if not self.connected:
            self.hand_over(0, self.end, question)
            return
        key, _, parameters = selector.partition("?")
        asyncio.get_running_loop().call_later(timeout, self.end, question)
        self.up.send(
            key,
            b"",
            lambda _: self.network.route_question(question, key, parameters),
            safe=False,
        )

    def close(self) -> None:
        if not self.closed:
            self.closed = True
            self.network.remove(self)

    # --- what happens inside -------------------------------------------------------------------------------------

    def require_open(self) -> None:
        if self.closed:
            raise zenoh.ZError("session closed")

    def put(self, key: str, payload: bytes, *, safe: bool) -> None:
        self.require_open()
        for tap in self.network.taps:
            tap(self, key, payload)
        if self.process.dead or not self.connected:
            return
        self.up.send(key, payload, lambda arrived: self.network.route(self, key, arrived, safe=safe), safe=safe)

    def tell_router(self, action: Callable[[], None]) -> None:
        if self.connected and not self.process.dead:
            self.up.send("", b"", lambda _: action(), safe=True)

    def answer(self, question: Question, replies: list[tuple[str, bytes]]) -> None:
        if self.process.dead or not self.connected:
            return
        if not replies:
            self.tell_router(lambda: self.network.finish_answer(question, self))
        for position, (key, payload) in enumerate(replies, start=1):
            last = position == len(replies)

            def pass_on(arrived: bytes, key: str = key, last: bool = last) -> None:
                self.network.route_reply(question, self, key, arrived, last=last)

            self.up.send(key, payload, pass_on, safe=False)

    def wants(self, key: str) -> bool:
        return any(meet(wanted, key) for wanted, _ in self.subscribers)

    def receive(self, key: str, payload: bytes) -> None:
        if self.hears is not None:
            payload = self.hears(key, payload)
        self.network.note(self, key, payload)
        for wanted, callback in self.subscribers:
            if meet(wanted, key):
                self.hand_over(len(payload), callback, Sample(key, Payload(payload), zenoh.SampleKind.PUT))

    def receive_question(self, question: Question, key: str, parameters: str) -> None:
        for served, callback in self.queryables:
            if meet(served, key):
                self.hand_over(0, callback, Query(self, question, parameters))

    def receive_reply(self, question: Question, key: str, payload: bytes, *, last: bool) -> None:
        self.network.note(self, key, payload)
        if not question.over:
            self.hand_over(0, question.callback, Reply(Sample(key, Payload(payload), zenoh.SampleKind.PUT)))
        if last:
            self.hand_over(0, self.end, question)

    def receive_life(self, key: str, kind: zenoh.SampleKind) -> None:
        if kind == zenoh.SampleKind.PUT:
            self.seen[key] = None
        else:
            self.seen.pop(key, None)
        for watched, callback in self.watchers:
            if meet(watched, key):
                self.hand_over(0, callback, Sample(key, Payload(b""), kind))

    def end(self, question: Question) -> None:
        """Nothing more will come; what is in comes before it."""
        if question in self.questions:
            self.questions.remove(question)
            question.over = True
            question.drop()

    def lose_router(self) -> None:
        """The connection is given up on this side: nobody is alive, no question will be answered."""
        for key in list(self.seen):
            self.receive_life(key, zenoh.SampleKind.DELETE)
        for question in self.questions:
            self.hand_over(0, self.end, question)

    def resumed(self) -> None:
        self._piled_bytes = 0

    def hand_over(self, size: int, callback: Callable[..., None], *arguments: object) -> None:
        """Let the process's zenoh thread call back; a stopped process takes no more than its buffers hold."""
        if self.process.dead:
            return
        if self.process.stopped:
            if size and self._piled_bytes + size > BUFFER_BYTES:
                self.network.counts["no room"] += 1
                return
            self._piled_bytes += size
        self.process.call(asyncio.get_running_loop().call_soon, callback, *arguments)
