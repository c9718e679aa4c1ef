"""Where a TOML file wrote each key: tomllib forgets it, and a fault without a line has to be searched for."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from typing import TypeAlias

KeyPath: TypeAlias = tuple[str | int, ...]
"""Keys and, inside arrays, indices from 0: ``("drones", 1, "start", 2)``."""

_TOKEN = re.compile(
    r"""(?P<newline>\r?\n)
      | (?P<blank>[ \t]+ | \#[^\n]*)
      | (?P<quoted>\"{3}(?:\\.|[^\\])*?\"{3,5} | '{3}.*?'{3,5} | \"(?:\\.|[^"\\])*\" | '[^']*')
      | (?P<sign>[\[\]{},=.])
      | (?P<bare>[^\s\[\]{},=.\#"']+)""",
    re.VERBOSE | re.DOTALL,
)


def key_lines(source: str) -> dict[KeyPath, int]:
    """Line, from 1, of every key, table and array element of a document that tomllib accepts."""
    return _Scanner(source).lines


def line_of(lines: Mapping[KeyPath, int], path: KeyPath) -> int:
    """Line of a key, or of the innermost table around it that was written; 1 if there is none."""
    while path and path not in lines:
        path = path[:-1]
    return lines.get(path, 1)


class _Scanner:
    def __init__(self, source: str) -> None:
        self.lines: dict[KeyPath, int] = {}
        self._tokens: list[tuple[str, str, int]] = []
        self._next = 0
        self._tables_in: dict[KeyPath, int] = {}
        line = 1
        for match in _TOKEN.finditer(source):
            if match.lastgroup != "blank":
                self._tokens.append((str(match.lastgroup), match[0], line))
            line += match[0].count("\n")
        self._document()

    def _peek(self) -> str:
        return self._tokens[self._next][1] if self._next < len(self._tokens) else "\n"

    def _skip(self, *texts: str) -> None:
        while self._next < len(self._tokens) and self._peek() in texts:
            self._next += 1

    def _document(self) -> None:
        table: KeyPath = ()
        while self._next < len(self._tokens):
            if self._peek() in ("\n", "\r\n"):
                self._next += 1
            elif self._peek() == "[":
                table = self._header()
            else:
                self._assignment(table)

    def _header(self) -> KeyPath:
        """``[a.b]`` or ``[[a.b]]``; names of arrays of tables lead to their newest element."""
        line = self._tokens[self._next][2]
        start = self._next
        self._skip("[")
        is_array = self._next - start > 1
        path: KeyPath = ()
        keys = self._key("]")
        for depth, key in enumerate(keys, start=1):
            path = (*path, key)
            self.lines.setdefault(path, line)
            if is_array and depth == len(keys):
                self._tables_in[path] = self._tables_in.get(path, 0) + 1
            if path in self._tables_in:
                path = (*path, self._tables_in[path] - 1)
                self.lines.setdefault(path, line)
        self._skip("]")
        return path

    def _key(self, end: str) -> list[str]:
        """The parts of a dotted key, up to and without ``end``."""
        parts = []
        while self._peek() != end:
            kind, text, _ = self._tokens[self._next]
            if kind == "quoted":
                parts.append(str(tomllib.loads(f"key = {text}")["key"]))
            elif kind == "bare":
                parts.append(text)
            self._next += 1
        return parts

    def _assignment(self, table: KeyPath) -> None:
        line = self._tokens[self._next][2]
        path = table
        for key in self._key("="):
            path = (*path, key)
            self.lines.setdefault(path, line)
        self._skip("=")
        self._value(path)

    def _value(self, path: KeyPath) -> None:
        opening = self._peek()
        if opening not in ("[", "{"):
            while self._peek() not in ("\n", "\r\n", ",", "]", "}"):
                self._next += 1
            return
        closing = "]" if opening == "[" else "}"
        self._next += 1
        self._skip("\n", "\r\n")
        index = 0
        while self._peek() != closing:
            if opening == "[":
                self.lines[(*path, index)] = self._tokens[self._next][2]
                self._value((*path, index))
                index += 1
            else:
                self._assignment(path)
            self._skip("\n", "\r\n", ",")
        self._next += 1
