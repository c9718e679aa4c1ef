"""Tells people whom the router refuses: zenoh says it on standard output alone, in its own words and far too much.

zenoh's lines go through a pipe to a thread that picks out refusals, puts them into one form, and logs of each the 1st,
2nd, 4th, 8th ...: whoever knocks for hours must not fill the disk.
"""

from __future__ import annotations

import logging
import os
import re
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import zenoh

log = logging.getLogger(__name__)

FILTER = "warn,zenoh::net::routing::interceptor::access_control=trace"
"""What zenoh is to tell: of access control each decision, because it has no other level for a refusal."""
KINDS_MAX = 1000
"""Of refusals that are counted apart: a stranger can make up as many keys as it likes."""
READ_BYTES = 2**18
ACTIONS = {
    "Put": "put",
    "Delete": "delete",
    "Query": "ask",
    "Reply": "answer to",
    "Declare Subscriber": "subscribe to",
    "Declare Queryable": "answer to",
    "Liveliness Token": "pass for",
    "Declare Liveliness Subscriber": "watch",
    "Liveliness Query": "ask for",
}
"""zenoh's names, and how the sentence goes on."""

_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_LINE = re.compile(r"\S+\s+(?P<level>[A-Z]+)\s+(?P<thread>.*?)(?P<target>zenoh[\w:]*): (?P<text>.*)")
_NAME = re.compile(r"(?P<zid>[0-9a-f]+) on .*?CertCommonName\((?P<name>[^)]*)\)")
_DENIED = re.compile(r"(?P<zid>[0-9a-f]+)(?: on \S+)? is unauthorized to (?P<action>.+?) \(ingress\) on (?P<key>.+)")
_CACHED = "Using cached result: "
_CACHING = re.compile(r"ACL \(\w+\): caching permissions for `(?P<key>.*)`")
_LAST_CACHED = "Declare Liveliness Subscriber"
"""What zenoh decides last when it decides in advance for a key, without anybody having asked."""


class Refusals:
    """Reads zenoh's lines one by one."""

    def __init__(self, namespace: str) -> None:
        self._prefix = f"{namespace}/"
        self._names: dict[str, str] = {}
        self._ahead: dict[str, str] = {}
        """Of each of zenoh's threads, the key for which it is deciding in advance."""
        self.counts: Counter[str] = Counter()

    def take(self, line: str) -> str:
        """What to tell people now; empty when there is nothing, or when it was said often enough."""
        text = self.read(line)
        if not text:
            return ""
        kind = re.sub(r"\d{4,}", "#", text)  # moments and numbers of seconds do not make another refusal
        if kind not in self.counts and len(self.counts) >= KINDS_MAX:
            kind = text = "refused: more kinds of things than are counted apart"
        self.counts[kind] += 1
        count = self.counts[kind]
        if count.bit_count() != 1:
            return ""
        return text if count == 1 else f"{text} (time {count})"

    def read(self, line: str) -> str:
        """What one line means, every time; empty for those that are no refusal."""
        found = _LINE.fullmatch(_COLOUR.sub("", line).strip())
        if found is None:
            return ""
        text = found["text"]
        if found["target"].endswith("::access_control"):
            return self._judge(found["thread"], text)
        if found["level"] not in ("WARN", "ERROR"):
            return ""
        reason = text.partition(". Hint:")[0].partition(" at /")[0]
        if found["target"].startswith("zenoh_link_tls"):
            return f"refused: a connection: {reason}"
        return f"zenoh: {reason}"

    def _judge(self, thread: str, text: str) -> str:
        caching = _CACHING.match(text)
        if caching:
            self._ahead[thread] = caching["key"]
            return ""
        named = _NAME.match(text)
        if named:
            if len(self._names) >= KINDS_MAX:
                self._names.clear()
            self._names[named["zid"]] = named["name"]
        denied = _DENIED.fullmatch(text.removeprefix(_CACHED))
        in_advance = not text.startswith(_CACHED) and thread in self._ahead
        if in_advance:
            if f"to {_LAST_CACHED}" in text:
                del self._ahead[thread]
            return ""
        if denied is None or denied["action"] not in ACTIONS:
            return ""
        who = self._names.get(denied["zid"], "somebody without a name")
        return f"refused: {who} may not {ACTIONS[denied['action']]} {denied['key'].removeprefix(self._prefix)}"


@contextmanager
def refusals_told(namespace: str, tell: Callable[[str], None] = log.warning) -> Iterator[Refusals]:
    """While this context lasts, tell of refusals; standard output is zenoh's. Once a process, before its sessions."""
    refusals = Refusals(namespace)
    outer = os.dup(1)
    reading, writing = os.pipe()
    os.dup2(writing, 1)
    os.close(writing)
    reader = threading.Thread(target=_read, args=(reading, refusals, tell), name="refusals", daemon=True)
    reader.start()
    zenoh.init_log_from_env_or(FILTER)
    try:
        yield refusals
    finally:
        os.dup2(outer, 1)  # closes the pipe's end, the reader's sign
        os.close(outer)
        reader.join(timeout=1.0)


def _read(pipe: int, refusals: Refusals, tell: Callable[[str], None]) -> None:
    """Until the other end is closed. Nothing may stop it before: zenoh would stand still before a full pipe."""
    rest = b""
    with open(pipe, "rb", buffering=0) as lines:
        while chunk := lines.read(READ_BYTES):
            *whole, rest = (rest + chunk).split(b"\n")
            for line in whole:
                # Thousands a second say that somebody may do something.
                if b"is authorized" in line and b"CertCommonName" not in line:
                    continue
                try:
                    text = refusals.take(line.decode(errors="replace"))
                    if text:
                        tell(text)
                except Exception:
                    log.exception("a line of zenoh's could not be read")
            rest = rest[-READ_BYTES:]
