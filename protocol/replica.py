"""phi as replicated state: the same jumps, each once and in order, and the same team states, in every process.

A replica remembers its last steps. So blocks of another replica's phi, true at an earlier tick, can be put in: they
are carried forward through the same steps to this replica's own tick, by the same kernel, and end in the same bytes.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from protocol.blocks import BlockLayout
from protocol.geometry import Floats
from protocol.importance import ImportanceField, SamplingTerms
from protocol.jump_queue import JumpQueue
from protocol.messages import Jump, PhiPage
from protocol.state_log import HISTORY_TICKS


@dataclass(frozen=True, slots=True)
class _Step:
    """What one tick did to phi: first the jumps, then the decay with ``poses`` (drones, 5)."""

    tick: int
    jumps: tuple[Jump, ...]
    poses: Floats
    dt: float


class Replica:
    """An importance field and how far it has got: in the journal, and in ticks."""

    def __init__(self, field: ImportanceField, epoch: int = 0) -> None:
        self.field = field
        self.layout = BlockLayout((field.phi.shape[0], field.phi.shape[1]))
        self.jumps = JumpQueue(epoch)
        self.tick = 0
        """All earlier ticks are integrated."""
        self.refused = 0
        """Jumps and pages of a wrong shape, type or epoch."""
        self._steps: deque[_Step] = deque(maxlen=HISTORY_TICKS)

    def hear(self, jump: Jump) -> None:
        """Take in a jump, whenever and however often it comes."""
        fits = jump.increments.dtype == np.float32 and jump.increments.shape == self.field.phi.shape[:1]
        if not (fits and self.jumps.hear(jump)):
            self.refused += 1

    def advance(self, tick: int, poses: Floats, dt: float, own: int = -1, *, jumps: bool = True) -> SamplingTerms:
        """Apply the jumps due by ``tick``, then integrate it with the team's ``poses`` (drones, 5), ordered by id.

        Without ``jumps`` they stay where they are: as long as it is open which of them phi has already.
        """
        due = self.jumps.take_due(tick) if jumps else ()
        for jump in due:
            self.field.jump(jump.increments)
        terms = self.field.advance(poses, dt, own)
        if self._steps and self._steps[-1].tick != tick - 1:
            self._steps.clear()
        self._steps.append(_Step(tick, due, poses, dt))
        self.tick = tick + 1
        return terms

    # --- blocks of others ----------------------------------------------------------------------------------------

    def page(self, blocks: list[int]) -> PhiPage:
        """As many of ``blocks`` as fit a page, as they are before this replica's next tick."""
        chosen = np.array(sorted(set(blocks))[: self.layout.blocks_a_page()], np.int32)
        return PhiPage(
            epoch=self.jumps.epoch,
            tick=self.tick,
            next_sequence=self.jumps.taken,
            blocks=chosen,
            phi=self.field.phi[self.layout.rows_of(chosen)],
        )

    def fits(self, page: PhiPage) -> bool:
        """Whether the page is one of this field; counted when it is not."""
        blocks, phi = page.blocks, page.phi
        fits = (
            blocks.dtype == np.int32
            and blocks.ndim == 1
            and bool((np.diff(blocks) > 0).all())
            and bool(((blocks >= 0) & (blocks < self.layout.count)).all())
            and phi.dtype == np.float32
            and phi.shape == (self.layout.rows_of(blocks).size, self.layout.directions)
        )
        self.refused += not fits
        return fits

    def is_placeable(self, page: PhiPage) -> bool:
        """Whether this replica has got as far as the page: in ticks, and in jumps, or one would be applied twice."""
        return page.tick <= self.tick and page.next_sequence <= self.jumps.taken

    def reaches_back(self, page: PhiPage) -> bool:
        """Whether the steps since the page's tick are remembered, and all jumps that it lacks and this replica has."""
        steps = page.tick == self.tick or bool(self._steps and self._steps[0].tick <= page.tick)
        jumps = sum(jump.epoch == page.epoch for step in self._steps for jump in step.jumps)
        return steps and self.jumps.taken - jumps <= page.next_sequence

    def place(self, page: PhiPage) -> None:
        """Put in a page that fits, is placeable and is reached back to, carried forward to this replica's tick."""
        first = 0
        for rows in map(self.layout.rows, page.blocks.tolist()):
            values = page.phi[first : first + rows.stop - rows.start]
            first += len(values)
            carried = self.field.part(rows.start, values)  # positions do not depend on each other
            for step in self._steps:
                for jump in step.jumps:
                    if jump.epoch == page.epoch and jump.sequence >= page.next_sequence:  # the page has the others
                        carried.jump(jump.increments)
                if step.tick >= page.tick:
                    carried.advance(step.poses, step.dt)
            self.field.overwrite(rows.start, carried.phi)
