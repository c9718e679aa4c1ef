"""What an operator may command (`ground_station.commands` says what each means); apart, so that help needs no more."""

from __future__ import annotations

from typing import Literal

Verb = Literal["start", "pause", "resume", "return", "land", "abort"]
