from __future__ import annotations

import tomllib

from hypothesis import given
from hypothesis import strategies as st

from protocol.toml_lines import KeyPath, key_lines, line_of

DOCUMENT = '''\
# [not_a_table]
title = "a # b = [c]"           # comment with [brackets]
text = """
three = 1
four = 2 \\""" still text """
raw = \'\'\'
"quoted = 1"\'\'\'
dotted.inner . deep = 1.5
"quoted key".x = 1

[table]
list = [ 1, [2,
  3],
  # between
  4, ]
inline = { a = 1, b = { c = [ { d = 1 } ] } }
when = 1979-05-27 07:32:00

[[many]]
id = 1
[many.sub]
x = 1
[[many]]
id = 2
[[many.nested]]
y = 1
[[many.nested]]
y = 2
'''


def test_every_key_is_found_on_its_line() -> None:
    lines = key_lines(DOCUMENT)

    expected: dict[KeyPath, int] = {
        ("title",): 2,
        ("text",): 3,
        ("raw",): 6,
        ("dotted", "inner", "deep"): 8,
        ("quoted key", "x"): 9,
        ("table",): 11,
        ("table", "list", 0): 12,
        ("table", "list", 1, 0): 12,
        ("table", "list", 1, 1): 13,
        ("table", "list", 2): 15,
        ("table", "inline", "b", "c", 0, "d"): 16,
        ("table", "when"): 17,
        ("many", 0, "id"): 20,
        ("many", 0, "sub"): 21,
        ("many", 0, "sub", "x"): 22,
        ("many", 1): 23,
        ("many", 1, "nested", 0, "y"): 26,
        ("many", 1, "nested", 1): 27,
        ("many", 1, "nested", 1, "y"): 28,
    }
    assert {path: lines.get(path) for path in expected} == expected


def test_windows_line_ends_count_once() -> None:
    assert key_lines("a = 1\r\n[b]\r\nc = 2\r\n") == {("a",): 1, ("b",): 2, ("b", "c"): 3}


def test_a_key_that_was_not_written_has_the_line_of_its_table() -> None:
    lines = key_lines("a = 1\n[b]\nc = 2\n")

    assert line_of(lines, ("b", "missing", 3)) == 2
    assert line_of(lines, ("missing",)) == 1


def _paths(value: object, path: KeyPath = ()) -> set[KeyPath]:
    if isinstance(value, dict):
        return {path} | {inner for key, item in value.items() for inner in _paths(item, (*path, key))}
    if isinstance(value, list):
        return {path} | {inner for index, item in enumerate(value) for inner in _paths(item, (*path, index))}
    return {path}


def test_the_paths_are_those_that_tomllib_reads() -> None:
    assert set(key_lines(DOCUMENT)) == _paths(tomllib.loads(DOCUMENT)) - {()}


VALUES = st.recursive(
    st.one_of(
        st.integers().map(str), st.just("true"), st.text("ab#=[],{}.' \t", max_size=8).map(lambda text: f'"{text}"')
    ),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3).map(lambda items: "[ " + ", ".join(items) + " ]"),
        st.lists(inner, max_size=3).map(lambda items: "[\n" + ",\n".join(items) + "\n]"),
        st.lists(inner, max_size=3).map(
            lambda items: "{" + ", ".join(f"k{index} = {item}" for index, item in enumerate(items)) + "}"
        ),
    ),
    max_leaves=8,
)


@given(st.lists(VALUES, max_size=5))
def test_any_nesting_of_values_gives_the_paths_that_tomllib_reads(values: list[str]) -> None:
    source = ""
    key_at: dict[KeyPath, int] = {}
    for index, value in enumerate(values):
        # TOML 1.0 wants an inline table on one line, whatever stands inside.
        flat = value.replace("\n", " ") if "{" in value else value
        key_at[f"key{index}",] = source.count("\n") + 1
        source += f"key{index} = {flat}\n"

    lines = key_lines(source)

    assert set(lines) == _paths(tomllib.loads(source)) - {()}
    assert {path: lines[path] for path in key_at} == key_at
