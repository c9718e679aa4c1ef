"""Jumps on their way out: numbered, on disk, and only then told; and the journal's answers to those who missed some.

The disk may take its time: everything that touches the journal runs on one thread of its own.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ground_station.journal import Journal, replace_journal
from protocol import topics
from protocol.bus import Bus
from protocol.errors import JournalError, MessageError
from protocol.messages import JournalPage, Jump
from protocol.replication import Replication
from protocol.wire import decode

T = TypeVar("T")

log = logging.getLogger(__name__)

NO_LIMIT = 2**62
"""Bytes of a page that does not travel."""


class JumpPublisher:
    def __init__(self, bus: Bus, journal: Journal, replication: Replication) -> None:
        self._bus, self._journal, self._replication = bus, journal, replication
        self._disk = ThreadPoolExecutor(1, thread_name_prefix="journal")
        self._refused: NDArray[np.float32] | None = None
        self.earlier = 0
        """Jumps of epochs before this one."""
        self.unwritten = 0
        """How often the disk refused something."""
        bus.serve(topics.JOURNAL, self._answer)

    @property
    def epoch(self) -> int:
        return self._journal.epoch

    @property
    def next_sequence(self) -> int:
        return self._journal.next_sequence

    @property
    def count(self) -> int:
        """Jumps since the start of the mission."""
        return self.earlier + self._journal.next_sequence

    def recall(self) -> None:
        """Tell the own phi all that the journal holds: after a restart."""
        for encoded in self._journal.page(self._journal.first_sequence, self._journal.next_sequence, NO_LIMIT):
            self._replication.hear_jump(decode(Jump, encoded))

    async def publish(self, increments: NDArray[np.float32], tick: int) -> Jump | None:
        """A jump of ``increments`` (positions,) that takes effect at ``tick``; the jump as it was told.

        What the disk refuses is not told to anybody; it is added to the next jump.
        """
        if self._refused is not None:
            increments = increments + self._refused
        jump = Jump(epoch=self.epoch, sequence=self.next_sequence, tick=tick, increments=increments)
        try:
            encoded = await self._on_disk(lambda: self._journal.append(jump))
        except JournalError as error:
            self.unwritten += 1
            self._refused = increments
            log.error("jump %d is held back: %s", jump.sequence, error)  # noqa: TRY400  # the disk's fault, not ours
            return None
        self._refused = None
        self._bus.put_encoded(topics.JUMP, encoded)
        self._replication.hear_jump(jump)
        return jump

    async def compact(self, below: int, limit_bytes: float) -> None:
        """Remove the jumps below that number once the journal is larger than ``limit_bytes``."""
        if self._journal.size_bytes <= limit_bytes:
            return
        try:
            await self._on_disk(lambda: self._journal.compact(below))
        except JournalError as error:
            self.unwritten += 1
            log.error("the journal stays as long as it is: %s", error)  # noqa: TRY400  # likewise

    async def renew(self, why: str) -> None:
        """Begin a new epoch: the journal lacks jumps that others have, so its numbers must not be used again.

        Raises:
            JournalError: the disk refuses it.
        """
        earlier = self.count
        self._journal = await self._on_disk(lambda: replace_journal(self._journal, why))
        self.earlier = earlier
        self._replication.renew(self._journal.epoch)

    async def _answer(self, parameters: dict[str, str]) -> JournalPage:
        journal = self._journal
        try:
            first, last = int(parameters.get("from", 0)), int(parameters.get("to", journal.next_sequence))
        except ValueError as error:
            raise MessageError(f"journal: from and to must be numbers: {parameters}") from error

        def page() -> JournalPage:
            return JournalPage(
                epoch=journal.epoch,
                first_sequence=journal.first_sequence,
                next_sequence=journal.next_sequence,
                jumps=journal.page(first, last),
            )

        return await self._on_disk(page)

    async def _on_disk(self, work: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._disk, work)

    def close(self) -> None:
        """The journal with it; an append that has begun is completed."""
        self._disk.shutdown(wait=True, cancel_futures=True)
        self._journal.close()
