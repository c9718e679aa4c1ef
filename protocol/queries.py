"""Questions over zenoh, asked and answered by coroutines."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Awaitable, Callable
from typing import TypeVar

import zenoh

from protocol.errors import BusError, MessageError, NoReply
from protocol.message_faults import MessageFaults
from protocol.session import errors_of
from protocol.topics import Topic
from protocol.wire import Message, encode

M = TypeVar("M", bound=Message)

log = logging.getLogger(__name__)


class Queries:
    """Of one session; belongs to the event loop that it is made in, as `protocol.bus.Bus` does."""

    def __init__(
        self, session: zenoh.Session, congestion_control: zenoh.CongestionControl, faults: MessageFaults
    ) -> None:
        self._session, self._congestion_control, self._faults = session, congestion_control, faults
        self._loop = asyncio.get_running_loop()
        self._declared: list[object] = []
        self._answers: set[asyncio.Task[None]] = set()

    def serve(self, topic: Topic[M], answer: Callable[[dict[str, str]], Awaitable[M]], key: str) -> None:
        """Answer queries under ``key``: ``answer`` runs as a task of the loop with the selector's parameters.

        It refuses a query by `MessageError`, and must end by itself when it waits for something: zenoh does not tell
        that the asker gave up. At most ``topic.queue`` run at once; further queries get no answer, and are counted.
        """
        places = threading.Semaphore(topic.queue)

        async def reply(query: zenoh.Query) -> None:
            refusal = b"failed"
            payload = b""
            try:
                payload = encode(await answer(parse_parameters(str(query.parameters))))
            except MessageError as error:
                refusal = str(error).encode()
            except Exception as error:  # noqa: BLE001 - a question must not end the process that is asked
                self._faults.fail(key, error)
            try:
                with errors_of(key):
                    if payload:
                        query.reply(key, payload)
                    else:
                        query.reply_err(refusal)
            except BusError as error:
                log.warning("cannot reply: %s", error)

        def end(query: zenoh.Query, task: asyncio.Task[None]) -> None:
            self._answers.discard(task)
            places.release()
            _drop(query)

        def start(query: zenoh.Query) -> None:
            task = self._loop.create_task(reply(query))
            self._answers.add(task)
            task.add_done_callback(lambda task: end(query, task))

        def arrive(query: zenoh.Query) -> None:
            if not places.acquire(blocking=False):
                self._faults.statistics.dropped[key] += 1
                _drop(query)
                return
            try:
                self._loop.call_soon_threadsafe(start, query)
            except RuntimeError:  # closed
                _drop(query)

        with errors_of(key):
            self._declared.append(self._session.declare_queryable(key, arrive))

    async def ask(self, topic: Topic[M], parameters: str, key: str, timeout_s: float) -> M:
        """The first valid answer to a query.

        Raises:
            NoReply: nobody answered in time; with zenoh an empty answer is no "no", so ask again.
        """
        replies: list[zenoh.Sample] = []
        done: asyncio.Future[None] = self._loop.create_future()

        def post(action: Callable[..., object], *arguments: object) -> None:
            try:
                self._loop.call_soon_threadsafe(action, *arguments)
            except RuntimeError:  # the loop is gone, and whoever asked with it
                return

        def arrive(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                post(replies.append, reply.ok)

        def finish() -> None:
            post(_settle, done)

        callback = zenoh.handlers.Callback(arrive, finish, indirect=False)
        with errors_of(key):
            self._session.get(
                f"{key}?{parameters}",
                callback,
                timeout=timeout_s,
                congestion_control=self._congestion_control,
                priority=getattr(zenoh.Priority, topic.priority),
            )
        await done
        for sample in replies:
            try:
                return topic.read(key, sample.payload)
            except MessageError as error:
                self._faults.refuse(key, error)
        raise NoReply(f"{key}?{parameters}: no valid answer")

    async def close(self) -> None:
        """No answer is given any more."""
        for task in self._answers:
            task.cancel()
        await asyncio.gather(*self._answers, return_exceptions=True)


def parse_parameters(selector: str) -> dict[str, str]:
    """``"from=3;to=9"`` as a dictionary."""
    return {key: value for key, _, value in (part.partition("=") for part in selector.split(";")) if key}


def _drop(query: zenoh.Query) -> None:
    """End a query: without it the asker waits for its whole time-out."""
    query.drop()  # type: ignore[no-untyped-call]  # zenoh's stub leaves it untyped


def _settle(future: asyncio.Future[None]) -> None:
    if not future.done():
        future.set_result(None)
