"""An asyncio loop whose time is counted, not measured: instead of sleeping it jumps to its next timer.

Minutes of a mission pass in seconds, and the same inputs give the same order of events. Several processes share the
loop: what is scheduled belongs to the `Process` in whose context that was done, and a process may be stopped, as by
SIGSTOP, or killed.
"""

from __future__ import annotations

import asyncio
import selectors
import threading
import time
from collections import deque
from collections.abc import Callable, Coroutine, Generator
from contextvars import Context, ContextVar, copy_context
from typing import Any, NoReturn, TypeVar, TypeVarTuple, Unpack
from unittest.mock import patch

T = TypeVar("T")
Ts = TypeVarTuple("Ts")

EXECUTOR_S = 0.02
"""Virtual time that anything takes in an executor."""
LIVELOCK_STEPS = 100_000
"""Turns of the loop without any time passing, after which somebody surely runs in a circle."""


class StandStill(Exception):
    """Nothing will ever happen again, or something goes on for ever without time passing."""


class Process:
    """What an operating system knows of one process: what it runs, whether it is stopped, whether it is dead."""

    def __init__(self, role: str) -> None:
        self.role = role
        self.stopped = False
        self.dead = False
        self.cpu_s = 0.0
        """What its callbacks took of a real processor, without what it gave to executors."""
        self.tasks: set[asyncio.Task[Any]] = set()
        """Those that have not ended; referred to here, because the code of a task that is collected would run on."""
        self._context = copy_context()
        self._context.run(_PROCESS.set, self)
        self._due: deque[_Call] = deque()

    def call(self, function: Callable[..., T], *arguments: Any) -> T:
        """Call ``function`` as this process: what it schedules is this process's."""
        return self._context.copy().run(function, *arguments)

    def start(self, coroutine: Coroutine[Any, Any, T]) -> asyncio.Task[T]:
        return asyncio.get_running_loop().create_task(coroutine, name=self.role, context=self._context.copy())

    def stop(self) -> None:
        """SIGSTOP: whatever comes due waits."""
        self.stopped = True

    def resume(self) -> None:
        """SIGCONT: all of it happens at once, in order."""
        self.stopped = False
        while self._due:
            call = self._due.popleft()
            asyncio.get_running_loop().call_soon(call, context=call.context)

    def kill(self) -> None:
        """SIGKILL: nothing of it ever runs again, no ``finally`` either; until `bury`."""
        self.dead = True
        self._due.clear()

    async def bury(self) -> None:
        """Let a dead process's tasks end, so that Python does not complain about them."""
        self.dead = self.stopped = False
        for task in self.tasks:
            task.cancel()
        await asyncio.gather(*self.tasks, return_exceptions=True)

    def holds(self, call: _Call) -> bool:
        """Whether ``call`` must not run now; it is kept for later, or forgotten if the process is dead."""
        if self.stopped and not self.dead:
            self._due.append(call)
        return self.stopped or self.dead


_PROCESS: ContextVar[Process | None] = ContextVar("process", default=None)


class _Call:
    """A callback that its process may hold back."""

    __slots__ = ("_arguments", "_callback", "_process", "context", "handle")

    def __init__(
        self, process: Process, context: Context, callback: Callable[..., object], arguments: tuple[Any, ...]
    ) -> None:
        self._process, self._callback, self._arguments = process, callback, arguments
        self.context = context
        self.handle: asyncio.Handle | None = None

    def __call__(self) -> None:
        assert self.handle is not None
        if not self.handle.cancelled() and not self._process.holds(self):
            began_s = time.process_time()
            self._callback(*self._arguments)
            self._process.cpu_s += time.process_time() - began_s


class _JumpingSelector(selectors.SelectSelector):
    """Waits by moving the clock; nothing ever comes in from outside."""

    def __init__(self) -> None:
        super().__init__()
        self.now_s = 0.0
        self._idle_steps = 0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        if timeout is None:
            raise StandStill("everybody waits, and no timer is set")
        self._idle_steps = 0 if timeout > 0 else self._idle_steps + 1
        if self._idle_steps > LIVELOCK_STEPS:
            raise StandStill(f"{LIVELOCK_STEPS} turns of the loop at {self.now_s:.6f} s")
        self.now_s += timeout
        return []


class VirtualLoop(asyncio.SelectorEventLoop):
    def __init__(self) -> None:
        self._clock = _JumpingSelector()
        super().__init__(self._clock)
        self.failures: list[str] = []
        """What asyncio would have logged: exceptions that nobody took."""
        self.set_exception_handler(self._note_failure)
        self.set_task_factory(self._make_task)

    def time(self) -> float:
        return self._clock.now_s

    def _note_failure(self, _loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        self.failures.append(f"{context['message']}: {context.get('exception')!r}")

    def _make_task(
        self,
        _loop: asyncio.AbstractEventLoop,
        coroutine: Coroutine[Any, Any, T] | Generator[Any, None, T],
        context: Context | None = None,
    ) -> asyncio.Task[T]:
        task: asyncio.Task[T] = asyncio.Task(coroutine, loop=self, context=context)
        process = _PROCESS.get() if context is None else context.get(_PROCESS)
        if process is not None:
            process.tasks.add(task)
            task.add_done_callback(process.tasks.discard)
        return task

    def call_soon(
        self, callback: Callable[[Unpack[Ts]], object], *args: *Ts, context: Context | None = None
    ) -> asyncio.Handle:
        context = copy_context() if context is None else context
        process = context.get(_PROCESS)
        if process is None:
            return super().call_soon(callback, *args, context=context)
        call = _Call(process, context, callback, args)
        call.handle = super().call_soon(call, context=context)
        return call.handle

    def call_at(
        self, when: float, callback: Callable[[Unpack[Ts]], object], *args: *Ts, context: Context | None = None
    ) -> asyncio.TimerHandle:
        context = copy_context() if context is None else context
        process = context.get(_PROCESS)
        if process is None:
            return super().call_at(when, callback, *args, context=context)
        call = _Call(process, context, callback, args)
        call.handle = timer = super().call_at(when, call, context=context)
        return timer

    def call_soon_threadsafe(
        self, callback: Callable[[Unpack[Ts]], object], *args: *Ts, context: Context | None = None
    ) -> asyncio.Handle:
        return self.call_soon(callback, *args, context=context)

    def run_in_executor(self, executor: object, func: Callable[..., T], *args: Any) -> asyncio.Future[T]:  # type: ignore[override]  # a future that nobody could await sooner
        """Call ``func`` now and give its result `EXECUTOR_S` later, whatever the executor."""
        del executor
        future: asyncio.Future[T] = self.create_future()
        began_s = time.process_time()
        try:
            result = func(*args)
        except Exception as error:  # noqa: BLE001  # handed to whoever awaits
            self.call_later(EXECUTOR_S, _settle, future, future.set_exception, error)
        else:
            self.call_later(EXECUTOR_S, _settle, future, future.set_result, result)
        process = _PROCESS.get()
        if process is not None:
            process.cpu_s -= time.process_time() - began_s
        return future


def _settle(future: asyncio.Future[T], settle: Callable[[Any], None], outcome: object) -> None:
    if not future.done():
        settle(outcome)


def _refuse_thread(thread: threading.Thread) -> NoReturn:
    raise AssertionError(f"{thread.name}: threads have no place in virtual time")


def run(main: Coroutine[Any, Any, T]) -> T:
    """Run ``main`` in virtual time, from 0 on; the standard library's clocks show it too.

    Raises:
        StandStill: ``main`` would never end.
    """
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        now_s = runner.get_loop().time
        with (
            patch.object(threading.Thread, "start", _refuse_thread),
            patch.object(time, "monotonic", now_s),
            patch.object(time, "perf_counter", now_s),
        ):
            return runner.run(main)
