"""Jumps of one epoch, each once and in order, however they arrive.

One that comes early is held until the gap before it is filled; one that comes again is dropped; one of another epoch
is refused, because its numbers mean something else.
"""

from __future__ import annotations

from collections import deque

from protocol.messages import Jump


class JumpQueue:
    def __init__(self, epoch: int = 0, next_sequence: int = 0) -> None:
        self.epoch = epoch
        """0 until a jump, a page or the head tells which journal there is."""
        self.next_sequence = next_sequence
        """Jumps below it are taken or ready."""
        self._held: dict[int, Jump] = {}
        self._ready: deque[Jump] = deque()

    @property
    def gap(self) -> tuple[int, int] | None:
        """Half-open range of sequence numbers that are missing before one that is held."""
        return (self.next_sequence, min(self._held)) if self._held else None

    @property
    def taken(self) -> int:
        """Jumps below it were handed out by `take_due`."""
        return self.next_sequence - len(self._ready)

    def hear(self, jump: Jump) -> bool:
        """Take in a jump, whenever and however often it comes; False when it is of another epoch."""
        if self.epoch not in (0, jump.epoch):
            return False
        self.epoch = jump.epoch
        if jump.sequence < self.next_sequence:
            return True
        self._held[jump.sequence] = jump
        while self.next_sequence in self._held:
            self._ready.append(self._held.pop(self.next_sequence))
            self.next_sequence += 1
        return True

    def take_due(self, tick: int) -> tuple[Jump, ...]:
        """Those that take effect by ``tick``, in order. One behind a later one waits for it."""
        due = []
        while self._ready and self._ready[0].tick <= tick:
            due.append(self._ready.popleft())
        return tuple(due)

    def restart(self, epoch: int, next_sequence: int) -> None:
        """Go on in ``epoch`` at ``next_sequence``: a snapshot holds all before. What is held of the epoch stays."""
        jumps = [*self._ready, *self._held.values()] if epoch == self.epoch else []
        self.epoch, self.next_sequence = epoch, next_sequence
        self._held.clear()
        self._ready.clear()
        for jump in jumps:
            self.hear(jump)
