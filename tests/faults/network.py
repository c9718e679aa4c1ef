"""A zenoh router with its clients, of which every link can be made bad.

It behaves as zenoh 1.10 was measured to: puts of a process without a connection vanish without an error, a question
that nobody serves ends at once and empty, one whose server is silent ends with its time-out, and whoever loses the
router is told that everybody is gone.
"""

from __future__ import annotations

import asyncio
import functools
import hashlib
import random
import struct
from collections import Counter
from collections.abc import Callable
from contextvars import Context
from dataclasses import replace

import zenoh

from faults.session import Question, Session, meet
from faults.virtual_loop import Process

LEASE_S = 2.0
"""A peer silent for 0.75 to 1 lease is given up."""
RECONNECT_S = 0.4
DEATH_S = 0.003
"""After which the router notices that a killed process's socket is closed."""


class Network:
    """The router, and the hand that makes links bad."""

    def __init__(self, dice: random.Random, garble: Callable[[str, bytes], bytes]) -> None:
        self.dice, self.garble = dice, garble
        self.counts: Counter[str] = Counter()
        """What happened to messages."""
        self.taps: list[Callable[[Session, str, bytes], None]] = []
        """Called with whatever is put, before anything can go wrong with it."""
        self._sessions: list[Session] = []
        self._lives: dict[str, Session] = {}
        self._questions: list[Question] = []
        self._digest = hashlib.blake2b()

    def session(self, process: Process) -> Session:
        session = Session(self, process)
        self._sessions.append(session)
        return session

    @property
    def digest(self) -> str:
        """Of all that anybody received, and when: equal for equal runs."""
        return self._digest.hexdigest()

    def note(self, session: Session, key: str, payload: bytes) -> None:
        self._digest.update(struct.pack("<d", asyncio.get_running_loop().time()))
        self._digest.update(f"{session.process.role} {key}".encode())
        self._digest.update(payload)

    # --- routing -------------------------------------------------------------------------------------------------

    def route(self, sender: Session, key: str, payload: bytes, *, safe: bool) -> None:
        for session in self._sessions:
            if session is not sender and session.connected and session.wants(key):
                session.down.send(key, payload, functools.partial(session.receive, key), safe=safe)

    def route_question(self, question: Question, key: str, parameters: str) -> None:
        servers = [
            session
            for session in self._sessions
            if session.connected and any(meet(served, key) for served, _ in session.queryables)
        ]
        question.awaited.update(servers)
        self._questions.append(question)
        for server in servers:

            def ask(_: bytes, server: Session = server) -> None:
                server.receive_question(question, key, parameters)

            server.down.send(key, b"", ask, safe=False)
        if not servers:
            self._finish(question)

    def route_reply(self, question: Question, server: Session, key: str, payload: bytes, *, last: bool) -> None:
        if last:
            question.awaited.discard(server)
        over = last and not question.awaited
        question.asker.down.send(
            key,
            payload,
            lambda arrived: question.asker.receive_reply(question, key, arrived, last=over),
            safe=False,
        )
        if over and question in self._questions:
            self._questions.remove(question)

    def finish_answer(self, question: Question, server: Session) -> None:
        question.awaited.discard(server)
        if not question.awaited:
            self._finish(question)

    def _finish(self, question: Question) -> None:
        if question in self._questions:
            self._questions.remove(question)
        asker = question.asker
        asker.down.send("", b"", lambda _: asker.hand_over(0, asker.end, question), safe=True)

    # --- who is alive --------------------------------------------------------------------------------------------

    def declare_alive(self, session: Session, key: str) -> None:
        self._lives[key] = session
        self._tell_all(key, zenoh.SampleKind.PUT)

    def tell_lives(self, session: Session) -> None:
        for key in self._lives:
            session.down.send(key, b"", functools.partial(_receive_life, session, key, zenoh.SampleKind.PUT), safe=True)

    def _tell_all(self, key: str, kind: zenoh.SampleKind) -> None:
        for session in self._sessions:
            if session.connected and session.watchers:
                session.down.send(key, b"", functools.partial(_receive_life, session, key, kind), safe=True)

    # --- faults --------------------------------------------------------------------------------------------------

    def black_hole(self, session: Session, *, active: bool) -> None:
        """Nothing passes in either direction, or everything again."""
        for link in (session.up, session.down):
            link.faults = replace(link.faults, black_hole=active)
        self._watch_lease(session)

    def stop(self, session: Session) -> None:
        """SIGSTOP."""
        session.process.stop()
        self._watch_lease(session)

    def resume(self, session: Session) -> None:
        """SIGCONT."""
        session.process.resume()
        session.resumed()
        self._watch_lease(session)

    def kill(self, session: Session) -> None:
        """SIGKILL."""
        session.process.kill()
        self._later(DEATH_S, self.remove, session)

    def remove(self, session: Session) -> None:
        """Its connection is closed, for good."""
        if session in self._sessions:
            self._sessions.remove(session)
            self._part(session)

    def reset(self, session: Session) -> None:
        """Its connection breaks at once, on both sides, and is made anew."""
        if session in self._sessions and session.connected:
            self._part(session)
            session.lose_router()
            self._watch_lease(session)

    def _part(self, session: Session) -> None:
        session.connected = False
        session.up.cut()
        session.down.cut()
        for key in [key for key, owner in self._lives.items() if owner is session]:
            del self._lives[key]
            self._tell_all(key, zenoh.SampleKind.DELETE)
        for question in list(self._questions):
            if session in question.awaited:
                self.finish_answer(question, session)

    def _watch_lease(self, session: Session) -> None:
        """After any change: a connection ends when it was silent for long, and comes back when it is not."""
        session.changes += 1
        if self._is_silent(session):
            self._later(LEASE_S * self.dice.uniform(0.75, 1.0), self._end_lease, session, session.changes)
        elif not session.connected:
            self._later(RECONNECT_S, self._reconnect, session, session.changes)

    def _is_silent(self, session: Session) -> bool:
        return session.process.stopped or session.up.faults.black_hole or session.down.faults.black_hole

    def _end_lease(self, session: Session, changes: int) -> None:
        if session in self._sessions and session.connected and session.changes == changes:
            self._part(session)
            session.lose_router()

    def _reconnect(self, session: Session, changes: int) -> None:
        if session in self._sessions and session.changes == changes:
            session.connected = True
            for key in session.tokens:
                self.declare_alive(session, key)
            self.tell_lives(session)

    def _later(self, delay_s: float, action: Callable[..., None], *arguments: object) -> None:
        """As nobody's: what a process set going goes on when it is stopped or killed."""
        asyncio.get_running_loop().call_later(delay_s, action, *arguments, context=Context())


def _receive_life(session: Session, key: str, kind: zenoh.SampleKind, _payload: bytes) -> None:
    session.receive_life(key, kind)
