"""zenoh for asyncio: the only module that knows the transport.

zenoh calls back on its own threads. Here they only hand over: a sample goes into its subscription's bounded queue,
and the event loop is woken once for a whole burst. Handlers then run in the loop, in order, and `Bus.until`
re-checks what is being waited for. Lost, late and refused messages are counted, never guessed at, and a handler or
an answer that fails costs its own message alone.

While the router is away, zenoh drops what is put, answers no question, and says of everybody that they are gone;
when it is back, all that was declared here is declared to it again.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Protocol, TypeVar

import zenoh

from protocol import service
from protocol.errors import BusError, MessageError
from protocol.message_faults import BusStatistics, MessageFaults
from protocol.queries import Queries
from protocol.session import Link, errors_of, open_client, open_router
from protocol.stuck_links import give_up_stuck_links
from protocol.topics import Topic, alive_key
from protocol.wire import Message, encode

M = TypeVar("M", bound=Message)
T = TypeVar("T")

log = logging.getLogger(__name__)

QUERY_TIMEOUT_S = 2.0


class LinkWatcher(Protocol):
    def __call__(self, address: str, name: str, *, there: bool) -> None: ...


@dataclass(slots=True)
class _Subscription:
    """One key's queue between zenoh's thread and the loop, and who reads it."""

    key: str
    topic: Topic[Any]
    take: Callable[[], zenoh.Sample | None]
    """The oldest message that waits."""
    handle: zenoh.Subscriber[Any]
    """Kept because zenoh undeclares a subscriber that nobody refers to."""
    handlers: list[Callable[[Any], None]] = field(default_factory=list)


class Bus:
    """One process's session. Make it with `connect`; it belongs to the event loop that opened it.

    ``put`` may be called from any thread, everything else from the loop's. Once it is closed, all of it raises
    `BusError`.
    """

    def __init__(self, session: zenoh.Session, *, lossless: bool) -> None:
        self._session = session
        self._loop = asyncio.get_running_loop()
        # Not BLOCK_FIRST either: on a narrow link it ends the session, and with a router that stands still it keeps
        # zenoh from noticing for ten seconds and more.
        self._congestion_control = zenoh.CongestionControl.BLOCK if lossless else zenoh.CongestionControl.DROP
        self._subscriptions: dict[tuple[str, bool], _Subscription] = {}
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._declared: list[object] = []
        self._waiting: list[tuple[Callable[[], bool], asyncio.Future[bool]]] = []
        self._woken = False
        self._closed = False
        self._lives: deque[tuple[str, bool]] = deque()
        self.alive: set[str] = set()
        """Roles with a liveliness token: "ground", "sim", "drone/1" ...; nobody while the router is away."""
        self.gone: set[str] = set()
        """Roles that had one and lost it. Whoever is in neither set may live already: a token may come after what its
        process said."""
        self._faults = MessageFaults()
        self._queries = Queries(session, self._congestion_control, self._faults)

    @property
    def statistics(self) -> BusStatistics:
        return self._faults.statistics

    # --- sending -------------------------------------------------------------------------------------------------

    def put(self, topic: Topic[M], message: M, drone: int | str = "") -> None:
        """Publish; a lossy bus drops the message when its link is congested."""
        self.put_encoded(topic, encode(message), drone)

    def put_encoded(self, topic: Topic[Any], payload: bytes, drone: int | str = "") -> None:
        key = topic.of(drone)
        with errors_of(key):
            publisher = self._publishers.get(key)
            if publisher is None:
                publisher = self._session.declare_publisher(
                    key,
                    congestion_control=self._congestion_control,
                    priority=getattr(zenoh.Priority, topic.priority),
                    express=topic.express,
                )
                self._publishers[key] = publisher
            publisher.put(payload)

    # --- receiving -----------------------------------------------------------------------------------------------

    def on(self, topic: Topic[M], handler: Callable[[M], None], drone: int | str = "*", *, wakes: bool = True) -> None:
        """Call ``handler`` in the loop with each message; several handlers share one subscription.

        ``wakes=False`` is for what is read once a tick, and costs about half the CPU: no message of this topic runs
        Python or wakes the loop by itself; it is handled when something else does, or by `poll`. What a full queue
        lost is then not in the statistics, because zenoh does not tell: readers count gaps in tick or sequence.
        """
        key = topic.of(drone)
        subscription = self._subscriptions.get((key, wakes))
        if subscription is None:
            with errors_of(key):
                subscription = (self._declare_waking if wakes else self._declare_ring)(key, topic)
            self._subscriptions[key, wakes] = subscription
        subscription.handlers.append(handler)

    def off(self, topic: Topic[Any], drone: int | str = "*", *, wakes: bool = True) -> None:
        """Undo `on`, for all handlers; what has not been handled yet is dropped."""
        key = topic.of(drone)
        with errors_of(key):
            self._subscriptions.pop((key, wakes)).handle.undeclare()  # type: ignore[no-untyped-call]  # as in _drop

    def _declare_waking(self, key: str, topic: Topic[Any]) -> _Subscription:
        queue: deque[zenoh.Sample] = deque(maxlen=topic.queue)

        def arrive(sample: zenoh.Sample) -> None:
            if len(queue) == topic.queue:
                self.statistics.dropped[key] += 1
            queue.append(sample)
            self._wake()

        handle = self._session.declare_subscriber(key, arrive, allowed_origin=zenoh.Locality.REMOTE)
        return _Subscription(key, topic, lambda: queue.popleft() if queue else None, handle)

    def _declare_ring(self, key: str, topic: Topic[Any]) -> _Subscription:
        ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(topic.queue)
        handle = self._session.declare_subscriber(key, ring, allowed_origin=zenoh.Locality.REMOTE)
        return _Subscription(key, topic, handle.try_recv, handle)

    def on_foreign(self, tell: Callable[[str], None]) -> None:
        """Have ``tell`` tell people, once for each key, that another major version speaks there; else it is logged."""
        self._faults.tell_foreign = tell

    async def until(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Wait until ``condition`` holds, checked after each burst of messages; False when time ran out.

        What ``condition`` raises is raised here.
        """
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
            if future.done():
                continue
            try:
                holds = condition()
            except Exception as error:  # noqa: BLE001 - raised where it is waited for, not in whoever woke us
                future.set_exception(error)
                continue
            if holds:
                future.set_result(True)

    def poll(self) -> None:
        """Handle now all that has arrived, also what does not wake."""
        if self._closed:
            raise BusError("poll: session closed")
        self._drain()

    def _wake(self) -> None:
        if self._woken or self._closed:
            return
        self._woken = True
        try:
            self._loop.call_soon_threadsafe(self._drain_unless_closed)
        except RuntimeError:  # the loop was closed while a zenoh thread was still handing over
            self._closed = True

    def _drain_unless_closed(self) -> None:
        if not self._closed:
            self._drain()

    def _drain(self) -> None:
        self._woken = False
        while self._lives:
            role, alive = self._lives.popleft()
            (self.alive.add if alive else self.alive.discard)(role)
            (self.gone.discard if alive else self.gone.add)(role)
        for subscription in list(self._subscriptions.values()):
            for _ in range(subscription.topic.queue):
                sample = subscription.take()
                if sample is None:
                    break
                self._deliver(subscription, sample)
        self.recheck()

    def _deliver(self, subscription: _Subscription, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        try:
            message = subscription.topic.read(key, sample.payload)
        except MessageError as error:
            self._faults.refuse(key, error)
            return
        for handler in subscription.handlers:
            try:
                handler(message)
            except Exception as error:  # noqa: BLE001 - a fault in one reader must not cost the others their messages
                self._faults.fail(subscription.key, error)

    # --- liveliness ----------------------------------------------------------------------------------------------

    def announce(self, role: str) -> None:
        """Declare this process alive; call it after everything it answers to is declared."""
        with errors_of(alive_key(role)):
            self._declared.append(self._session.liveliness().declare_token(alive_key(role)))

    def watch_lives(self) -> None:
        """Keep `alive` up to date, with those that were there before."""
        prefix = alive_key("")

        def change(sample: zenoh.Sample) -> None:
            role = str(sample.key_expr).removeprefix(prefix)
            self._lives.append((role, sample.kind == zenoh.SampleKind.PUT))
            self._wake()

        with errors_of(alive_key("**")):
            self._declared.append(self._session.liveliness().declare_subscriber(alive_key("**"), change, history=True))

    def watch_links(self, told: LinkWatcher) -> None:
        """Have ``told`` called, in the loop, with the address and the certificate's common name of each link that comes
        or goes."""

        def change(event: zenoh.LinkEvent) -> None:
            there = event.kind == zenoh.SampleKind.PUT
            name = event.link.auth_identifier or "somebody without a certificate"
            try:
                self._loop.call_soon_threadsafe(partial(told, str(event.link.dst), name, there=there))
            except RuntimeError:  # closed
                return

        with errors_of("links"):
            self._declared.append(self._session.info.declare_link_events_listener(change, history=True))

    def give_up_stuck_links(self) -> None:
        """Of those over TLS (`protocol.stuck_links`)."""
        with errors_of("links"):
            self._declared.append(give_up_stuck_links(self._session))

    # --- queries -------------------------------------------------------------------------------------------------

    def serve(self, topic: Topic[M], answer: Callable[[dict[str, str]], Awaitable[M]], drone: int | str = "") -> None:
        """Answer queries for ``topic`` (`Queries.serve`)."""
        self._queries.serve(topic, answer, topic.of(drone))

    async def ask(
        self, topic: Topic[M], parameters: str, drone: int | str = "", timeout_s: float = QUERY_TIMEOUT_S
    ) -> M:
        """The first valid answer to a query (`Queries.ask`)."""
        return await self._queries.ask(topic, parameters, topic.of(drone), timeout_s)

    async def close(self) -> None:
        self._closed = True
        await self._queries.close()
        # Closing joins zenoh's threads, which may be about to call into this loop.
        try:
            with errors_of("close"):
                await asyncio.to_thread(self._session.close)
        except BusError as error:  # a link that lets nothing through: zenoh waited for it and has given up
            log.warning("%s", error)


@asynccontextmanager
async def connect(
    link: Link | str,
    mission: str,
    *,
    router: bool = False,
    lossless: bool = False,
    timeout_s: float = 30.0,
    uplinks: Sequence[str] = (),
    access: dict[str, Any] | None = None,
) -> AsyncIterator[Bus]:
    """A bus in the namespace of ``mission``; the router listens at the link's endpoint, everybody else connects to it.

    A client waits up to ``timeout_s`` for the router to appear. ``lossless`` makes every put wait for a congested
    link instead of dropping: for lockstep simulation, where a lost message would change the outcome.

    Args:
        link: a bare endpoint is one without alternatives and credentials.
        uplinks: endpoints of other routers that a router connects to.
        access: of a router, whom it lets do what (`protocol.access`).

    Raises:
        BusError: the endpoint is malformed, taken or open to strangers, or nobody listened in time.
    """
    if isinstance(link, str):
        link = Link(link)
    if router:
        session = await open_router(link, mission, uplinks=uplinks, access=access)
    else:
        session = await open_client(link, mission, timeout_s=timeout_s)
    bus = Bus(session, lossless=lossless)
    service.ready(f"{'listening at' if router else 'connected to'} {link.endpoint}")
    if link.credentials is not None:
        bus.give_up_stuck_links()
    try:
        yield bus
    finally:
        await bus.close()


def _settle(future: asyncio.Future[T], result: T) -> None:
    if not future.done():
        future.set_result(result)
