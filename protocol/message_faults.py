"""Messages that were lost, refused, or made whoever read them fail: counted, and told without filling the disk."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

from protocol.errors import MessageError, VersionError

log = logging.getLogger(__name__)


@dataclass(slots=True)
class BusStatistics:
    refused: Counter[str] = field(default_factory=Counter)
    """Messages that are too long, do not decode or speak for somebody else, by the key that they came under."""
    dropped: Counter[str] = field(default_factory=Counter)
    """Messages and questions that a full queue lost, by topic."""
    failed: Counter[str] = field(default_factory=Counter)
    """Messages and questions that made their handler raise, by topic."""

    @property
    def unused(self) -> int:
        """All of them."""
        return self.refused.total() + self.dropped.total() + self.failed.total()


class MessageFaults:
    """Of one process's bus."""

    def __init__(self) -> None:
        self.statistics = BusStatistics()
        self.tell_foreign: Callable[[str], None] = log.error
        """Called once for each key under which another major version speaks."""
        self._foreign: set[str] = set()

    def refuse(self, key: str, error: MessageError) -> None:
        """Count, and log the 1st, 2nd, 4th, 8th ...: a storm of bad messages must not fill the disk."""
        self.statistics.refused[key] += 1
        count = self.statistics.refused[key]
        if isinstance(error, VersionError) and key not in self._foreign:
            self._foreign.add(key)
            self.tell_foreign(f"{key}: {error}: install the same release on both sides")
        elif count.bit_count() == 1:
            log.warning("%s: message %d refused: %s", key, count, error)

    def fail(self, key: str, error: Exception) -> None:
        """Likewise."""
        self.statistics.failed[key] += 1
        if self.statistics.failed[key].bit_count() == 1:
            log.error("%s: failure %d", key, self.statistics.failed[key], exc_info=error)
