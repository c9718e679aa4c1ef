"""Names of the quadratic program's rows in words that an operator reads."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from protocol.airspace import in_words as in_words_of_zone
from protocol.messages import UNLIMITED

BOUNDS: Final = {
    "x": "speed limit along x",
    "y": "speed limit along y",
    "z": "speed limit along z",
    "yaw": "turn rate limit",
    "pitch": "tilt rate limit",
}
"""Of the velocity that the program looks for; a limit of acceleration shows as one of these as well."""


def in_words(row: str) -> str:
    """``separation:2`` -> "distance to drone 2". A name that is not known is its own description."""
    kind, _, what = row.partition(":")
    match kind:
        case "separation":
            return f"distance to drone {what}"
        case "region":
            return f"edge of the region ({what})"
        case "zone":
            return in_words_of_zone(what)
        case "obstacle":
            return "an obstacle, or what nobody has seen"
        case "pitch":
            return "range of the gimbal"
        case "bound" if what in BOUNDS:
            return BOUNDS[what]
        case _:
            return row


def all_in_words(rows: Iterable[str]) -> str:
    """With commas between them; empty when there is none."""
    return ", ".join(in_words(row) for row in rows)


def margin(value: float) -> float | None:
    """A margin of a decision; None where there is no such row."""
    return value if value < UNLIMITED else None
