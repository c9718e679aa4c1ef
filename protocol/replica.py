"""phi as replicated state: the same jumps, each once and in order, and the same team states, in every process.

Jumps come from the ground station's journal alone, numbered within an epoch. One that comes early is held until the
gap before it is filled; one that comes again is dropped; one of another epoch is refused, because its numbers mean
something else.
"""

from __future__ import annotations

import numpy as np

from protocol.geometry import Floats
from protocol.importance import ImportanceField, SamplingTerms
from protocol.messages import Jump


class Replica:
    """An importance field and the position in the journal up to which it has taken jumps in."""

    def __init__(self, field: ImportanceField, epoch: int = 0) -> None:
        self.field = field
        self.epoch = epoch
        """0 until the first jump tells which journal there is."""
        self.next_sequence = 0
        """Jumps below it are held in order or applied."""
        self.refused = 0
        """Jumps of a wrong shape, type or epoch."""
        self._held: dict[int, Jump] = {}
        self._ready: list[Jump] = []

    @property
    def gap(self) -> tuple[int, int] | None:
        """Half-open range of sequence numbers that are missing before one that is held."""
        return (self.next_sequence, min(self._held)) if self._held else None

    def hear(self, jump: Jump) -> None:
        """Take in a jump, whenever and however often it comes."""
        fits = jump.increments.dtype == np.float32 and jump.increments.shape == self.field.phi.shape[:1]
        if not fits or self.epoch not in (0, jump.epoch):
            self.refused += 1
            return
        self.epoch = jump.epoch
        if jump.sequence < self.next_sequence:
            return
        self._held[jump.sequence] = jump
        while self.next_sequence in self._held:
            self._ready.append(self._held.pop(self.next_sequence))
            self.next_sequence += 1

    def advance(self, tick: int, poses: Floats, dt: float, own: int = -1) -> SamplingTerms:
        """Apply the jumps due by ``tick``, then integrate the tick with the team's ``poses`` (drones, 5)."""
        while self._ready and self._ready[0].tick <= tick:
            self.field.jump(self._ready.pop(0).increments)
        return self.field.advance(poses, dt, own)
