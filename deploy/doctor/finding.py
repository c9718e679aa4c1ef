"""What a check comes to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Level = Literal["ok", "warn", "fail"]
"""warn: it flies, but worse or less safely; fail: it does not."""


@dataclass(frozen=True, slots=True)
class Finding:
    subject: str
    """What was looked at, in a word or two."""
    level: Level
    text: str
    advice: str = ""
    """What to do about it; empty where all is well."""
