"""The edge where errors of MAVSDK become ours."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from mavsdk import MavsdkError

from protocol.errors import VehicleError


@contextmanager
def refusals(doing: str) -> Iterator[None]:
    """Whatever MAVSDK raises inside becomes a `VehicleError` that says what was being done.

    Plugins raise an error of their own with a ``result``; a connection raises without one; a plugin that is used after
    its `Mavsdk` was destroyed raises `RuntimeError`, and one made of a system that is gone `ValueError`.
    """
    try:
        yield
    except (MavsdkError, RuntimeError, ValueError) as error:
        result = getattr(error, "result", None)
        why = str(error) if result is None else result.name.lower().replace("_", " ")
        raise VehicleError(f"{doing}: {why}") from error
