"""What a process has to say to people: a line in its log, and an event for whoever watches the mission."""

from __future__ import annotations

import logging
from collections.abc import Callable

from protocol.bus import Bus
from protocol.errors import BusError
from protocol.messages import Event, EventLevel
from protocol.topics import Topic

Tell = Callable[[EventLevel, str, str], None]
"""Level, kind (`protocol.messages.Event.kind`), text."""

TEXT_LETTERS = 1000
"""As many as an event takes."""

log = logging.getLogger(__name__)


class News:
    def __init__(
        self,
        bus: Bus,
        topic: Topic[Event],
        source: str,
        drone: int | str = "",
        *,
        keep: Callable[[Event], None] = lambda _event: None,
    ) -> None:
        """``source``: the role of this process; ``drone``: whose key of ``topic`` it is, if it has any; ``keep``: who
        else is told, from any thread."""
        self._bus, self._topic, self._drone, self._keep = bus, topic, drone, keep
        self._source = source
        self.tick = 0
        """Of the mission, now."""

    def tell(self, level: EventLevel, kind: str, text: str) -> None:
        """From any thread."""
        log.log(logging.getLevelNamesMapping()[level.upper()], "%s: %s", kind, text)
        event = Event(source=self._source, tick=self.tick, level=level, kind=kind, text=text[:TEXT_LETTERS])
        self._keep(event)
        try:
            self._bus.put(self._topic, event, self._drone)
        except BusError as error:  # the process is ending, and its log has it
            log.debug("%s", error)
