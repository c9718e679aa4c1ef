"""Wire format: one MessagePack map of a version, a message name and typed fields, checked by pydantic.

Arrays travel as ``[dtype, shape, little-endian bytes]``. Whatever does not fit exactly - another major version, a
wrong type, a wrong length, a number that is not finite - is refused with `MessageError`; nothing is guessed. Nor
does a length that the bytes only claim cost memory or time before it is refused.

Processes of different minor versions understand each other: a newer one may add fields, which an older one passes over
and for which a newer one that does not find them takes their defaults. So what lies within a message is sent without
the fields that are at theirs.
"""

from __future__ import annotations

import math
import reprlib
from collections.abc import Callable, Sized
from functools import cache
from typing import Annotated, Any, ClassVar, TypeVar

import msgpack
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PlainSerializer, ValidationError

from protocol.errors import MessageError, VersionError

WIRE_VERSION = 1
"""Major version. Whatever an older process would misunderstand changes it: a field that is gone, another meaning, a new
value of an enumeration."""
WIRE_MINOR = 4
"""Of a major version; one more with each release that adds fields, which must have defaults."""
MAX_MESSAGE_BYTES = 16 * 2**20
MAX_MEMBERS = 2**12
"""Of one map or tuple; bulk travels as bytes."""
MAX_DIMENSIONS = 4
"""Of an array. The product of a shape that is as long as a message takes minutes to compute."""
MAX_MEMBERS_IN_ALL = 2**16
"""One byte can be an empty map, which takes Python 64. A message of fewer bytes cannot have more members."""
PLACE_LETTERS = 40
"""Of each part of a place that an error names: an unknown field's name is whatever the sender made it."""
_ARRAY_DTYPES = ("<f4", "<f8", "<i2", "<i4", "|u1")

Finite = Annotated[float, Field(allow_inf_nan=False)]


def _array_from_wire(value: object) -> NDArray[Any]:
    if isinstance(value, np.ndarray):
        return _checked(value)
    match value:
        case (str(dtype), tuple(shape), bytes(data)) if dtype in _ARRAY_DTYPES:
            pass
        case _:
            raise ValueError("not an array of [dtype, shape, bytes]")
    if len(shape) > MAX_DIMENSIONS:
        raise ValueError(f"{len(shape)} dimensions exceed the limit of {MAX_DIMENSIONS}")
    if not all(type(length) is int and 0 <= length <= MAX_MESSAGE_BYTES for length in shape):
        raise ValueError(f"shape {reprlib.repr(shape)} is not made of lengths")
    if math.prod(shape) * np.dtype(dtype).itemsize != len(data):
        raise ValueError(f"{len(data)} bytes do not fill shape {shape} of {dtype}")
    return _checked(np.frombuffer(data, dtype).reshape(shape))


def _checked(array: NDArray[Any]) -> NDArray[Any]:
    """Also for the sender's own arrays: what every receiver would refuse must not be journalled or published."""
    if array.dtype.newbyteorder("<").str not in _ARRAY_DTYPES:
        raise ValueError(f"arrays of {array.dtype} do not travel")
    if array.ndim > MAX_DIMENSIONS:
        raise ValueError(f"{array.ndim} dimensions exceed the limit of {MAX_DIMENSIONS}")
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ValueError("holds numbers that are not finite")
    return array


def _array_to_wire(array: NDArray[Any]) -> tuple[str, tuple[int, ...], bytes]:
    little = array.dtype.newbyteorder("<")
    return little.str, array.shape, np.ascontiguousarray(array, little).tobytes()


WireArray = Annotated[
    NDArray[Any], BeforeValidator(_array_from_wire), PlainSerializer(_array_to_wire, return_type=tuple)
]


class Message(BaseModel):
    """Base of all that crosses a process boundary; ``name`` tells which message the bytes hold."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, arbitrary_types_allowed=True, use_attribute_docstrings=True
    )
    name: ClassVar[str]


M = TypeVar("M", bound=Message)
C = TypeVar("C", bound=Sized)


def encode(message: Message) -> bytes:
    """Bytes for `decode`.

    Raises:
        MessageError: longer than any receiver accepts.
    """
    version = {"v": WIRE_VERSION, "m": WIRE_MINOR} if WIRE_MINOR else {"v": WIRE_VERSION}
    packed: bytes = msgpack.packb({**version, "n": message.name, **message.__dict__}, default=_plain)
    if len(packed) > MAX_MESSAGE_BYTES:
        raise MessageError(f"{message.name}: {len(packed)} bytes exceed the limit of {MAX_MESSAGE_BYTES}")
    return packed


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray):
        return _array_to_wire(value)
    if isinstance(value, BaseModel):
        defaults = _defaults(type(value))
        fields = value.__dict__.items()
        return {name: field for name, field in fields if name not in defaults or field != defaults[name]}
    raise TypeError(f"{type(value).__name__} has no wire format")


@cache
def _defaults(kind: type[BaseModel]) -> dict[str, Any]:
    return {name: field.default for name, field in kind.model_fields.items() if not field.is_required()}


def decode(kind: type[M], data: bytes) -> M:
    """The message in ``data``.

    Raises:
        VersionError: another major version speaks.
        MessageError: anything else that is not exactly a ``kind``.
    """
    if len(data) > MAX_MESSAGE_BYTES:
        raise MessageError(f"{kind.name}: {len(data)} bytes exceed the limit of {MAX_MESSAGE_BYTES}")
    try:
        fields = _unpacked(data)
    except (ValueError, TypeError, msgpack.UnpackException) as error:
        raise MessageError(f"{kind.name}: not MessagePack: {error}") from error
    if not isinstance(fields, dict):
        raise MessageError(f"{kind.name}: not a map")
    version, minor, name = fields.pop("v", None), fields.pop("m", 0), fields.pop("n", None)
    if type(version) is not int or version != WIRE_VERSION:  # True and 1.0 equal 1
        raise VersionError(f"{kind.name}: wire version {reprlib.repr(version)}, this process speaks {WIRE_VERSION}")
    if type(minor) is not int or minor < 0:
        raise MessageError(f"{kind.name}: minor wire version {reprlib.repr(minor)}")
    if name != kind.name:
        raise MessageError(f"{kind.name}: holds a message {reprlib.repr(name)}")
    try:
        return kind.model_validate(fields, extra="ignore" if minor > WIRE_MINOR else "forbid")
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        place = ".".join(str(part)[:PLACE_LETTERS] for part in first["loc"])
        raise MessageError(f"{kind.name}.{place}: {first['msg']}") from error


def _unpacked(data: bytes) -> object:
    hook = _count_members() if len(data) > MAX_MEMBERS_IN_ALL else None
    return msgpack.unpackb(
        data, use_list=False, max_array_len=MAX_MEMBERS, max_map_len=MAX_MEMBERS, object_hook=hook, list_hook=hook
    )


def _count_members() -> Callable[[C], C]:
    """For each map and tuple that is complete: refuse them once they have too many members altogether."""
    members = 0

    def count(container: C) -> C:
        nonlocal members
        members += 1 + len(container)
        if members > MAX_MEMBERS_IN_ALL:
            raise ValueError(f"more than {MAX_MEMBERS_IN_ALL} members")
        return container

    return count
