"""Whatever bytes arrive on whatever topic: a message or a `MessageError`, without much memory.

Valid messages are made from the fields' annotations, so that a new message or field is covered without being named.
"""

from __future__ import annotations

import copy
import struct
import tracemalloc
import types
from collections.abc import Callable, Iterator
from functools import cache
from typing import Annotated, Any, Literal, TypeAlias, Union, get_args, get_origin, get_type_hints

import msgpack
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from pydantic.fields import FieldInfo

from protocol.errors import MessageError
from protocol.messages import Quaternion
from protocol.topics import TOPICS
from protocol.wire import MAX_MEMBERS, MAX_MESSAGE_BYTES, Message, WireArray, decode, encode

KINDS = tuple({topic.message.name: topic.message for topic in TOPICS}.values())
Place: TypeAlias = tuple[str | int, ...]
each_kind = pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
reproducible = settings(
    max_examples=40,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)


# --- messages, valid and otherwise -----------------------------------------------------------------------------------


@cache
def valid(kind: type[Message]) -> st.SearchStrategy[Message]:
    hints = get_type_hints(kind, include_extras=True)
    return st.builds(kind, **{name: values(hints[name]) for name in kind.model_fields})


def values(annotation: Any) -> st.SearchStrategy[Any]:
    """Of a field that is annotated so."""
    if annotation == Quaternion:
        return st.sampled_from([(1.0, 0.0, 0.0, 0.0), (0.0, -0.6, 0.0, 0.8), (0.5, 0.5, -0.5, 0.5)])
    if annotation == WireArray:
        return st.sampled_from(["<f4", "<f8", "<i2", "<i4", "|u1"]).flatmap(finite_arrays)
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        bounds = {}
        for field in inner[1:]:
            assert isinstance(field, FieldInfo)
            for bound in field.metadata:
                bounds |= {
                    name: getattr(bound, name) for name in ("ge", "gt", "le", "max_length") if hasattr(bound, name)
                }
        return numbers_or_rows(inner[0], bounds)
    if origin in (Union, types.UnionType):
        return st.one_of(*map(values, inner))
    if origin is Literal:
        return st.sampled_from(inner)
    if origin is tuple:
        return numbers_or_rows(annotation, {}) if inner[-1] is ... else st.tuples(*map(values, inner))
    if isinstance(annotation, type) and issubclass(annotation, Message):
        return valid(annotation)
    plain: dict[object, st.SearchStrategy[Any]] = {
        type(None): st.none(),
        bool: st.booleans(),
        str: st.text(max_size=8),
        bytes: st.binary(max_size=16),
    }
    return plain[annotation]


def numbers_or_rows(annotation: Any, bounds: dict[str, Any]) -> st.SearchStrategy[Any]:
    if annotation is int:
        return st.integers(bounds.get("ge"), bounds.get("le", 2**63 - 1))
    if annotation is float:
        low, above = bounds.get("ge"), bounds.get("gt")
        return st.floats(
            low if above is None else above,
            bounds.get("le"),
            exclude_min=above is not None,
            allow_nan=False,
            allow_infinity=False,
        )
    if annotation is str:
        return st.text(max_size=min(8, bounds["max_length"]))
    row, _ = get_args(annotation)
    return st.lists(values(row), max_size=min(3, bounds.get("max_length", 3))).map(tuple)


def finite_arrays(dtype: str) -> st.SearchStrategy[Any]:
    elements = {"allow_nan": False, "allow_infinity": False} if dtype[1] == "f" else {}
    return arrays(dtype, array_shapes(min_dims=0, max_dims=2, min_side=0, max_side=4), elements=elements)


numbers = st.integers(-(2**63), 2**64 - 1) | st.floats() | st.booleans()
leaves = (
    st.none()
    | numbers
    | st.text(max_size=8)
    | st.binary(max_size=16)
    | st.sampled_from(["<f4", "<f8", "<i4", "|u1", "jump", "flying"])
    | st.builds(msgpack.ExtType, st.integers(0, 127), st.binary(max_size=8))
    | st.builds(msgpack.Timestamp, st.integers(0, 2**40), st.integers(0, 10**9 - 1))
)
structures = st.recursive(
    leaves,
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.text(max_size=8) | st.binary(max_size=4), inner, max_size=4)
        | st.tuples(st.sampled_from(["<f4", "|u1"]), st.lists(numbers, max_size=4), st.binary(max_size=16))
    ),
    max_leaves=12,
)
claims = st.sampled_from(
    [
        header + struct.pack(">" + width, claim)
        for header, width in (
            (b"\xc4", "B"),
            (b"\xc5", "H"),
            (b"\xc6", "I"),
            (b"\xd9", "B"),
            (b"\xda", "H"),
            (b"\xdb", "I"),
            (b"\xdc", "H"),
            (b"\xdd", "I"),
            (b"\xde", "H"),
            (b"\xdf", "I"),
            (b"\xc9", "I"),
        )
        for claim in (0, 1, 2 ** (8 * struct.calcsize(width)) - 1)
    ]
)
"""Headers of bytes, texts, arrays, maps and extensions that say how long they are."""


def places(tree: object, here: Place = ()) -> Iterator[Place]:
    """Of every value inside of a tree of maps and lists."""
    inner = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in inner:
        yield (*here, key)
        yield from places(value, (*here, key))


def replaced(fields: dict[str, Any], place: Place, value: object) -> bytes:
    changed = copy.deepcopy(fields)
    inner: Any = changed
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    packed: bytes = msgpack.packb(changed)
    return packed


def decode_or_refuse(kind: type[Message], data: bytes) -> None:
    """What is let in must also be fit to be sent on."""
    try:
        message = decode(kind, data)
    except MessageError as error:
        assert len(str(error)) < 1000, "an error must fit a log line"  # noqa: PT017 - nothing else may be raised
        return
    assert encode(decode(kind, encode(message))) == encode(message)


# --- properties ------------------------------------------------------------------------------------------------------


@each_kind
@reproducible
@given(data=st.data())
def test_a_valid_message_comes_out_as_it_went_in(kind: type[Message], data: st.DataObject) -> None:
    message = data.draw(valid(kind))

    again = decode(kind, encode(message))

    assert encode(again) == encode(message)
    assert repr(again) == repr(message)


@each_kind
@reproducible
@given(data=st.binary(max_size=200))
def test_arbitrary_bytes_are_refused(kind: type[Message], data: bytes) -> None:
    with pytest.raises(MessageError):
        decode(kind, data)


@each_kind
@reproducible
@given(structure=structures)
def test_arbitrary_structures_are_refused(kind: type[Message], structure: object) -> None:
    with pytest.raises(MessageError):
        decode(kind, msgpack.packb(structure))


@each_kind
@reproducible
@given(data=st.data())
def test_a_message_with_anything_in_one_place_is_a_message_or_refused(kind: type[Message], data: st.DataObject) -> None:
    fields = msgpack.unpackb(encode(data.draw(valid(kind))))
    place = data.draw(st.sampled_from(list(places(fields))))

    decode_or_refuse(kind, replaced(fields, place, data.draw(structures)))


@each_kind
@reproducible
@given(data=st.data())
def test_a_message_with_flipped_bits_is_a_message_or_refused(kind: type[Message], data: st.DataObject) -> None:
    encoded = bytearray(encode(data.draw(valid(kind))))
    for at in data.draw(st.lists(st.integers(0, 8 * len(encoded) - 1), min_size=1, max_size=3)):
        encoded[at // 8] ^= 1 << at % 8

    decode_or_refuse(kind, bytes(encoded))


@each_kind
@reproducible
@given(data=st.data())
def test_a_truncated_message_is_refused(kind: type[Message], data: st.DataObject) -> None:
    encoded = encode(data.draw(valid(kind)))

    with pytest.raises(MessageError):
        decode(kind, encoded[: data.draw(st.integers(0, len(encoded) - 1))])


@each_kind
@reproducible
@given(data=st.data())
def test_a_message_that_claims_another_length_is_a_message_or_refused(kind: type[Message], data: st.DataObject) -> None:
    encoded = encode(data.draw(valid(kind)))
    at, claim = data.draw(st.integers(0, len(encoded))), data.draw(claims)

    decode_or_refuse(kind, encoded[:at] + claim + encoded[at:])
    decode_or_refuse(kind, encoded[:at] + claim + encoded[at + len(claim) :])


@each_kind
@reproducible
@given(data=st.data())
def test_a_message_that_names_a_field_twice_is_a_message_or_refused(kind: type[Message], data: st.DataObject) -> None:
    fields = msgpack.unpackb(encode(data.draw(valid(kind))))
    name = data.draw(st.sampled_from(list(fields)))
    packer = msgpack.Packer(autoreset=False)
    packer.pack_map_pairs([*fields.items(), (name, data.draw(structures))])

    decode_or_refuse(kind, packer.bytes())


@each_kind
@pytest.mark.parametrize("depth", [10, 500, 1000, 1020, 5000, 100_000])
def test_a_nest_is_refused_wherever_it_stands(kind: type[Message], depth: int) -> None:
    """Deeper than Python's own recursion goes, and than MessagePack's."""
    for field in ("v", "n", *kind.model_fields, "surprise"):
        for nest in (b"\x91" * depth, b"\x81\xa1v" * depth):
            head = {"v": 1, "n": kind.name}
            head.pop(field, None)
            body = b"".join(msgpack.packb(part) for pair in head.items() for part in pair)
            with pytest.raises(MessageError):
                decode(kind, bytes([0x81 + len(head)]) + body + msgpack.packb(field) + nest + b"\xc0")


# --- memory ----------------------------------------------------------------------------------------------------------


def array_header(members: int) -> bytes:
    return b"\xdd" + struct.pack(">I", members)


def rows(row: bytes) -> bytes:
    """As many of them as a message can hold, in arrays of allowed length."""
    block = array_header(MAX_MEMBERS) + row * MAX_MEMBERS
    count = (MAX_MESSAGE_BYTES - 100) // len(block)
    return array_header(count) + block * count


BOMBS: dict[str, Callable[[], bytes]] = {
    "an array that is not there": lambda: array_header(2**32 - 1),
    "arrays in arrays that are not there": lambda: (array_header(2**22) * 500).ljust(2**22 + 10, b"\x00"),
    "arrays of allowed length in each other": lambda: (array_header(MAX_MEMBERS) * 1000).ljust(2**16, b"\x00"),
    "a map that is not there": lambda: b"\xdf" + struct.pack(">I", 2**32 - 1),
    "a text that is not there": lambda: b"\xdb" + struct.pack(">I", 2**32 - 1),
    "bytes that are not there": lambda: b"\xc6" + struct.pack(">I", 2**32 - 1),
    "empty maps": lambda: rows(b"\x80"),
    "small maps": lambda: rows(b"\x81\xa1a\x00"),
    "short texts": lambda: rows(b"\xa2ab"),
    "numbers": lambda: rows(b"\xcb" + bytes(8)),
    "extensions": lambda: rows(b"\xc7\x00\x01"),
    "an array of an enormous shape": lambda: msgpack.packb(["<f4", [2**64 - 1] * MAX_MEMBERS, b""]),
    "an array of a large shape": lambda: msgpack.packb(["<f8", [2**20, 2**20], b""]),
    "an array of many axes": lambda: msgpack.packb(["<f8", [1] * 64, bytes(8)]),
}
ROOM_BYTES = 40 * 2**20
"""Peak beside the message itself: `MAX_MEMBERS_IN_ALL` small objects, or a thousand nested arrays of `MAX_MEMBERS`."""


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind.name in ("jump", "state")], ids=lambda kind: kind.name)
@pytest.mark.parametrize("bomb", BOMBS.values(), ids=BOMBS)
def test_a_bomb_is_refused_before_it_takes_memory(kind: type[Message], bomb: Callable[[], bytes]) -> None:
    field = msgpack.packb("increments" if kind.name == "jump" else "control")
    data = b"\x83\xa1v\x01\xa1n" + msgpack.packb(kind.name) + field + bomb()
    tracemalloc.start()
    try:
        with pytest.raises(MessageError):
            decode(kind, data)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()

    assert peak < ROOM_BYTES


def test_a_long_message_of_ordinary_members_is_let_in() -> None:
    """The bounds lie far from what is sent: a keyframe of megabytes, a jump for a large field."""
    jump = next(kind for kind in KINDS if kind.name == "jump")
    message = jump(epoch=1, sequence=2, tick=3, increments=np.ones(10**6, np.float32))

    assert repr(decode(jump, encode(message))) == repr(message)
