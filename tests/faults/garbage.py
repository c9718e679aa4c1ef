"""Bytes that are no message of their topic, as a broken sender makes them, and messages of a wrong clock."""

from __future__ import annotations

import random
from collections.abc import Callable

from faults.session import meet
from protocol import topics
from protocol.errors import MessageError
from protocol.messages import Tick
from protocol.topics import TOPICS, Topic
from protocol.wire import Message, decode, encode

LONGEST_BYTES = 400
"""Of rubbish that resembles nothing."""


def topic_of(key: str) -> Topic[Message] | None:
    """None for a key that no topic has."""
    return next((topic for topic in TOPICS if meet(topic.of("*"), key)), None)


def is_message(key: str, payload: bytes) -> bool:
    """Whether any reader of ``key`` would take it."""
    topic = topic_of(key)
    try:
        return topic is not None and bool(decode(topic.message, payload))
    except MessageError:
        return False


class Rubbish:
    """Makes rubbish of messages; never a valid one, which no reader could tell from the truth."""

    def __init__(self, dice: random.Random) -> None:
        self._dice = dice

    def __call__(self, key: str, payload: bytes) -> bytes:
        kind = self._dice.choice((self._flipped, self._torn, self._noise))
        rubbish = kind(payload)
        return rubbish if not is_message(key, rubbish) else self._torn(payload)

    def _flipped(self, payload: bytes) -> bytes:
        """Some bits the other way round."""
        changed = bytearray(payload)
        for _ in range(self._dice.randint(1, 8) if changed else 0):
            changed[self._dice.randrange(len(changed))] ^= 1 << self._dice.randrange(8)
        return bytes(changed)

    def _torn(self, payload: bytes) -> bytes:
        return payload[: self._dice.randrange(len(payload))] if payload else b""

    def _noise(self, _payload: bytes) -> bytes:
        return self._dice.randbytes(self._dice.randrange(LONGEST_BYTES))


def clock_ahead(ticks: int) -> Callable[[str, bytes], bytes]:
    """What a process hears whose clock is ``ticks`` ahead: what it says then carries the wrong ticks by itself."""

    def hears(key: str, payload: bytes) -> bytes:
        if key != topics.TICK.key or not is_message(key, payload):
            return payload
        tick = decode(Tick, payload)
        return encode(tick.model_copy(update={"tick": tick.tick + ticks}))

    return hears
