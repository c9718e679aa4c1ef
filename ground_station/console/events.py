"""What has happened, for the console's list."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final, Literal

from protocol.messages import Event

Level = Literal["info", "warning", "error"]

SEVERITY: Final[dict[Level, int]] = {"info": 0, "warning": 1, "error": 2}
CAPACITY: Final = 1000
"""Of each level."""


@dataclass(frozen=True, slots=True)
class EventFilter:
    level: Level = "info"
    """The least severe that is shown."""
    source: str = ""
    """Role, or "" for all; likewise ``kind``."""
    kind: str = ""
    text: str = ""
    """What the event's text contains, whatever the case."""

    def shows(self, event: Event) -> bool:
        return (
            SEVERITY[event.level] >= SEVERITY[self.level]
            and self.source in ("", event.source)
            and self.kind in ("", event.kind)
            and self.text.casefold() in event.text.casefold()
        )


ALL: Final = EventFilter()


class EventList:
    """Each level has room of its own: many small events do not drive out the one that matters."""

    def __init__(self, capacity: int = CAPACITY) -> None:
        self._kept: dict[Level, deque[tuple[int, Event]]] = {level: deque(maxlen=capacity) for level in SEVERITY}
        self._heard = 0

    def add(self, event: Event) -> None:
        self._heard += 1
        self._kept[event.level].append((self._heard, event))

    @property
    def heard(self) -> int:
        """How many so far, whether they are still here or not."""
        return self._heard

    def newest(self, count: int = 100, chosen: EventFilter = ALL) -> tuple[Event, ...]:
        """At most ``count`` that the filter shows, in the order in which they came, newest first."""
        shown = [numbered for kept in self._kept.values() for numbered in kept if chosen.shows(numbered[1])]
        shown.sort(key=lambda numbered: numbered[0], reverse=True)
        return tuple(event for _, event in shown[:count])

    @property
    def sources(self) -> tuple[str, ...]:
        """Who has said something, ascending: what there is to filter by; likewise `kinds`."""
        return tuple(sorted({event.source for kept in self._kept.values() for _, event in kept}))

    @property
    def kinds(self) -> tuple[str, ...]:
        return tuple(sorted({event.kind for kept in self._kept.values() for _, event in kept}))
