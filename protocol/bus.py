"""zenoh for asyncio: the only module that knows the transport.

zenoh calls back on its own threads. Here they only hand over: a sample goes into its subscription's bounded queue,
and the event loop is woken once for a whole burst. Handlers then run in the loop, in order, and `Bus.until`
re-checks what is being waited for. Lost, late and refused messages are counted, never guessed at.
"""

from __future__ import annotations

import asyncio
import json
from collections import Counter, deque
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

import zenoh

from protocol.errors import BusError, MessageError, NoReply
from protocol.topics import Topic, alive_key
from protocol.wire import MAX_MESSAGE_BYTES, Message, decode, encode

M = TypeVar("M", bound=Message)
T = TypeVar("T")

CONNECT_RETRY_S = 0.2
LEASE_MS = 2000
"""A process that vanishes without closing is noticed after 0.75 to 1 lease."""
BLOCK_MS = 500
"""How long a lossless put may wait for a slow link before the link is given up."""
QUERY_TIMEOUT_S = 2.0


def _config(mode: Literal["router", "client"], endpoint: str, namespace: str) -> zenoh.Config:
    place = "listen" if mode == "router" else "connect"
    settings: dict[str, Any] = {
        "mode": mode,
        place: {"endpoints": [endpoint]},
        "namespace": namespace,
        "timestamping": {"enabled": False},
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            "shared_memory": {"enabled": False},
            "link": {
                "tx": {
                    "lease": LEASE_MS,
                    "queue": {"congestion_control": {"block": {"wait_before_close": BLOCK_MS * 1000}}},
                },
                "rx": {"max_message_size": MAX_MESSAGE_BYTES},
            },
        },
    }
    if mode == "client":
        settings["connect"] |= {
            "timeout_ms": 2000,
            "retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2},
        }
    return zenoh.Config.from_json5(json.dumps(settings))


@contextmanager
def _errors_of(what: str) -> Iterator[None]:
    """zenoh's errors as `BusError`, without the place in its source that it appends."""
    try:
        yield
    except zenoh.ZError as error:
        raise BusError(f"{what}: {str(error).partition(' at /')[0]}") from error


@dataclass(slots=True)
class _Subscription:
    """One key's queue between zenoh's thread and the loop, and who reads it."""

    topic: Topic[Any]
    handlers: list[Callable[[Any], None]]
    queue: deque[bytes]
    handle: object = None
    """Kept because zenoh undeclares a subscriber that nobody refers to."""


@dataclass(slots=True)
class BusStatistics:
    refused: Counter[str] = field(default_factory=Counter)
    """Messages that did not decode, by topic."""
    dropped: Counter[str] = field(default_factory=Counter)
    """Messages that a full queue lost, by topic."""


class Bus:
    """One process's session. Make it with `connect`; it belongs to the event loop that opened it.

    ``put`` may be called from any thread, everything else from the loop's. Once it is closed, all of it raises
    `BusError`.
    """

    def __init__(self, session: zenoh.Session, *, lossless: bool) -> None:
        self._session = session
        self._loop = asyncio.get_running_loop()
        self._lossless = lossless
        self._subscriptions: dict[str, _Subscription] = {}
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._declared: list[object] = []
        self._waiting: list[tuple[Callable[[], bool], asyncio.Future[bool]]] = []
        self._woken = False
        self._closed = False
        self._lives: deque[tuple[str, bool]] = deque()
        self.alive: set[str] = set()
        """Roles with a liveliness token: "ground", "sim", "drone/1" ..."""
        self.statistics = BusStatistics()

    # --- sending -------------------------------------------------------------------------------------------------

    def put(self, topic: Topic[M], message: M, drone: int | str = "") -> None:
        """Publish; a lossy bus drops the message when its link is congested."""
        self.put_encoded(topic, encode(message), drone)

    def put_encoded(self, topic: Topic[Any], payload: bytes, drone: int | str = "") -> None:
        key = topic.of(drone)
        with _errors_of(key):
            publisher = self._publishers.get(key)
            if publisher is None:
                control = zenoh.CongestionControl.BLOCK if self._lossless else zenoh.CongestionControl.DROP
                publisher = self._session.declare_publisher(
                    key,
                    congestion_control=control,
                    priority=getattr(zenoh.Priority, topic.priority),
                    express=topic.express,
                )
                self._publishers[key] = publisher
            publisher.put(payload)

    # --- receiving -----------------------------------------------------------------------------------------------

    def on(self, topic: Topic[M], handler: Callable[[M], None], drone: int | str = "*") -> None:
        """Call ``handler`` in the loop with each message; several handlers share one subscription."""
        key = topic.of(drone)
        known = self._subscriptions.get(key)
        if known is not None:
            known.handlers.append(handler)
            return
        subscription = _Subscription(topic, [handler], deque(maxlen=topic.queue))
        self._subscriptions[key] = subscription

        def arrive(sample: zenoh.Sample) -> None:
            if len(subscription.queue) == topic.queue:
                self.statistics.dropped[key] += 1
            subscription.queue.append(sample.payload.to_bytes())
            self._wake()

        with _errors_of(key):
            subscription.handle = self._session.declare_subscriber(key, arrive, allowed_origin=zenoh.Locality.REMOTE)

    async def until(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Wait until ``condition`` holds, checked after each burst of messages; False when time ran out."""
        if condition():
            return True
        future: asyncio.Future[bool] = self._loop.create_future()
        entry = (condition, future)
        self._waiting.append(entry)
        timer = self._loop.call_later(timeout_s, _settle, future, False)
        try:
            return await future
        finally:
            timer.cancel()
            self._waiting.remove(entry)

    def recheck(self) -> None:
        """Tell `until` that something other than a message has changed."""
        for condition, future in self._waiting:
            if not future.done() and condition():
                _settle(future, True)

    def _wake(self) -> None:
        if self._woken or self._closed:
            return
        self._woken = True
        try:
            self._loop.call_soon_threadsafe(self._drain)
        except RuntimeError:  # the loop was closed while a zenoh thread was still handing over
            self._closed = True

    def _drain(self) -> None:
        self._woken = False
        while self._lives:
            role, alive = self._lives.popleft()
            (self.alive.add if alive else self.alive.discard)(role)
        for key, subscription in list(self._subscriptions.items()):
            for _ in range(len(subscription.queue)):
                try:
                    message = decode(subscription.topic.message, subscription.queue.popleft())
                except MessageError:
                    self.statistics.refused[key] += 1
                    continue
                for handler in subscription.handlers:
                    handler(message)
        self.recheck()

    # --- liveliness ----------------------------------------------------------------------------------------------

    def announce(self, role: str) -> None:
        """Declare this process alive; call it after everything it answers to is declared."""
        with _errors_of(alive_key(role)):
            self._declared.append(self._session.liveliness().declare_token(alive_key(role)))

    def watch_lives(self) -> None:
        """Keep `alive` up to date, with those that were there before."""
        prefix = alive_key("")

        def change(sample: zenoh.Sample) -> None:
            role = str(sample.key_expr).removeprefix(prefix)
            self._lives.append((role, sample.kind == zenoh.SampleKind.PUT))
            self._wake()

        with _errors_of(alive_key("**")):
            self._declared.append(self._session.liveliness().declare_subscriber(alive_key("**"), change, history=True))

    # --- queries -------------------------------------------------------------------------------------------------

    def serve(self, topic: Topic[M], answer: Callable[[dict[str, str]], M]) -> None:
        """Answer queries for ``topic``: ``answer`` runs in the loop with the selector's parameters."""

        def reply(query: zenoh.Query) -> None:
            with query:
                try:
                    query.reply(topic.key, encode(answer(parse_parameters(str(query.parameters)))))
                except MessageError as error:
                    query.reply_err(str(error).encode())

        def arrive(query: zenoh.Query) -> None:
            try:
                self._loop.call_soon_threadsafe(reply, query)
            except RuntimeError:  # closed: the query's drop tells the asker
                return

        with _errors_of(topic.key):
            self._declared.append(self._session.declare_queryable(topic.key, arrive))

    async def ask(self, topic: Topic[M], parameters: str) -> M:
        """The first valid answer to a query.

        Raises:
            NoReply: nobody answered in time; with zenoh an empty answer is no "no", so ask again.
        """
        replies: list[bytes] = []
        done: asyncio.Future[None] = self._loop.create_future()

        def post(action: Callable[..., object], *arguments: object) -> None:
            try:
                self._loop.call_soon_threadsafe(action, *arguments)
            except RuntimeError:  # the loop is gone, and whoever asked with it
                return

        def arrive(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                post(replies.append, reply.ok.payload.to_bytes())

        def finish() -> None:
            post(_settle, done, None)

        callback = zenoh.handlers.Callback(arrive, finish, indirect=False)
        with _errors_of(topic.key):
            self._session.get(f"{topic.key}?{parameters}", callback, timeout=QUERY_TIMEOUT_S)
        await done
        for payload in replies:
            try:
                return decode(topic.message, payload)
            except MessageError:
                self.statistics.refused[topic.key] += 1
        raise NoReply(f"{topic.key}?{parameters}: no valid answer")

    def close(self) -> None:
        self._closed = True
        self._session.close()  # type: ignore[no-untyped-call]  # zenoh's stub leaves it untyped


@asynccontextmanager
async def connect(
    endpoint: str,
    mission: str,
    *,
    router: bool = False,
    lossless: bool = False,
    timeout_s: float = 30.0,
) -> AsyncIterator[Bus]:
    """A bus in the namespace of ``mission``; the router listens at ``endpoint``, everybody else connects to it.

    A client waits up to ``timeout_s`` for the router to appear. ``lossless`` makes every put wait for a congested
    link instead of dropping: for lockstep simulation, where a lost message would change the outcome.

    Raises:
        BusError: the endpoint is malformed, taken, or nobody listened in time.
    """
    loop = asyncio.get_running_loop()
    deadline = loop.time() + timeout_s
    what = f"cannot {'listen at' if router else 'reach'} {endpoint or 'an empty endpoint'}"
    with _errors_of(what):
        config = _config("router" if router else "client", endpoint, f"covrecon/{mission}")
    while True:
        try:
            with _errors_of(what):
                session = await asyncio.to_thread(zenoh.open, config)
            break
        except BusError:
            if router or loop.time() > deadline:
                raise
            await asyncio.sleep(CONNECT_RETRY_S)
    bus = Bus(session, lossless=lossless)
    try:
        yield bus
    finally:
        # Closing joins zenoh's threads, which may be about to call into this loop.
        await asyncio.to_thread(bus.close)


def parse_parameters(selector: str) -> dict[str, str]:
    """``"from=3;to=9"`` as a dictionary."""
    return {key: value for key, _, value in (part.partition("=") for part in selector.split(";")) if key}


def _settle(future: asyncio.Future[T], result: T) -> None:
    if not future.done():
        future.set_result(result)
