"""What an operator may command, and how it is asked for; `ground_station.commands` says what each means. Apart from the
messages, so that help needs no more."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

Verb = Literal["start", "pause", "resume", "return", "land", "abort"]

ASK_AGAIN_S, ASK_TIMEOUT_S = 0.3, 1.0
"""A command is asked for until all have acknowledged it: pause between two questions, and patience with each."""


def command_parameters(identity: str, verb: Verb, drones: Iterable[int]) -> str:
    """Parameters of the query ``command/request``; no ``drones``: all."""
    return f"id={identity};verb={verb};drones={'+'.join(map(str, drones))}"
