"""What one process knows of the team's phi, and what it has to ask for: the rules, without transport.

A tick is integrated when the states of all its live drones are in and all jumps due by it are known to be in, or when
it has waited long enough; then what is missing is left out. Such a replica drifts, and is told so by the ground
station's digests: it fetches the blocks that differ. One that starts late fetches all of them the same way.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from protocol.blocks import SKETCHES
from protocol.errors import MessageError
from protocol.field import VirtualField
from protocol.geometry import Floats
from protocol.importance import ImportanceField, SamplingTerms
from protocol.messages import (
    DroneState,
    JournalPage,
    Jump,
    JumpHead,
    PhiDigest,
    PhiPage,
    ReplicaState,
    Tick,
)
from protocol.mission import Mission
from protocol.replica import Replica
from protocol.state_log import HISTORY_TICKS, StateLog
from protocol.team_states import Sighting
from protocol.wire import decode

log = logging.getLogger(__name__)

AHEAD_TICKS = 40
"""States of ticks further ahead of this process's own clock are refused: their sender's clock is wrong."""
TOO_FAR_BEHIND_TICKS = HISTORY_TICKS // 2
"""A replica that slept longer than this fetches phi instead of integrating what it can no longer know."""


@dataclass(frozen=True, slots=True)
class JournalRequest:
    """Jumps ``first`` to ``last`` - 1."""

    first: int
    last: int


@dataclass(frozen=True, slots=True)
class BlocksRequest:
    """Blocks of phi as they are when all ticks before ``tick``, or more, are integrated."""

    blocks: tuple[int, ...]
    tick: int


Request: TypeAlias = JournalRequest | BlocksRequest


@dataclass(frozen=True, slots=True)
class Integrated:
    """One tick that was integrated, with whom."""

    tick: int
    ids: list[int]
    poses: Floats
    """(drones, 5)."""
    terms: SamplingTerms | None
    """Of this process's own drone, when it is among them."""
    aground: Mapping[int, Floats] = field(default_factory=dict)
    """Poses (5,) of those who stood on the ground and will fly again."""


class Replication:
    def __init__(self, mission: Mission, own: int = 0, *, authority: bool = False, epoch: int = 0) -> None:
        """``own``: the drone whose sampling terms are wanted; 0 for none. ``authority``: the ground station, which
        nobody corrects."""
        self._mission, self._own, self._authority = mission, own, authority
        self.log = StateLog()
        self.replica = Replica(ImportanceField(VirtualField.of(mission.target), mission.sensing), epoch)
        self._drones = {drone.id for drone in mission.drones}
        self._digest_ticks = max(1, round(mission.replication.digest_period_s / mission.tick_s))
        self._lives: dict[int, tuple[int, ...]] = {}
        self._live: tuple[int, ...] = ()
        self._aground: dict[int, tuple[int, ...]] = {}
        self._now = -1
        self._done = -1
        self._head_sequence = 0
        self._head_epoch = epoch
        self._wanted: set[int] = set()
        self._wanted_from = 0
        self._resequence = False  # whether the next page tells from which jump on to go on
        self._pages: list[PhiPage] = []
        self._sketches: dict[tuple[int, int], NDArray[np.float32]] = {}  # by tick and first block
        self._digests: dict[tuple[int, int], PhiDigest] = {}
        self._reached: list[tuple[int, Callable[[], None]]] = []
        self.known = False
        """Whether phi has been complete once: before, nothing must be decided by it."""
        self.whole = False
        """Whether all of it is what the journal and the states told; not so while it is fetched anew."""
        self.repaired = 0
        """Blocks that had drifted and were replaced."""
        self.lost = 0
        """States of live drones that did not come in time, and whose decay is left out."""
        self.skewed = 0
        """States refused because they claim to be of a tick far ahead, or of a drone that is not in the mission."""

    # --- hearing -------------------------------------------------------------------------------------------------

    def hear_tick(self, tick: Tick) -> None:
        """Who is live at it; in lockstep also that all jumps due by it are out."""
        if self._now < 0:
            self._begin(tick.tick)
        self._lives[tick.tick] = tick.live
        if tick.aground:
            self._aground[tick.tick] = tick.aground
        if tick.tick >= self._now:
            self._now, self._live = tick.tick, tick.live
        if tick.lockstep:
            self._note_head(tick.jump_epoch, tick.next_jump, tick.tick)

    def hear_state(self, state: DroneState | Sighting) -> bool:
        """False when it is refused: of a drone that is not in the mission, or of a clock that is wrong."""
        ahead = self._now >= 0 and state.tick > self._now + AHEAD_TICKS
        if ahead or state.drone not in self._drones:
            self.skewed += 1
            return False
        self.log.hear(state)
        return True

    def hear_jump(self, jump: Jump) -> None:
        self.replica.hear(jump)

    def hear_head(self, head: JumpHead) -> None:
        self._note_head(head.epoch, head.next_sequence, head.done)

    def hear_digest(self, digest: PhiDigest) -> None:
        sketches, first = digest.sketches, digest.first_block
        fits = sketches.dtype == np.float32 and sketches.ndim == 2 and sketches.shape[1] == SKETCHES
        if not (fits and range(first, first + len(sketches)) in self.replica.layout.parts):
            self.replica.refused += 1
        elif not self._authority and digest.epoch == self.replica.jumps.epoch:
            self._digests[digest.tick, first] = digest
            self._compare(digest.tick, first)

    def hear_journal(self, page: JournalPage, request: JournalRequest) -> None:
        """Raises `MessageError` when a jump of it cannot be read."""
        if page.epoch == self.replica.jumps.epoch and page.first_sequence > request.first:
            self._want_all(self._now + 1)
            self._resequence = True
            return
        for encoded in page.jumps:
            self.hear_jump(decode(Jump, encoded))
        self._place_pages()

    def hear_page(self, page: PhiPage) -> None:
        """Blocks that were asked for."""
        if not self.replica.fits(page):
            return
        jumps = self.replica.jumps
        if self._authority:  # its own journal tells which jumps there are, also when it had to begin a new one
            if page.epoch != jumps.epoch:
                page = page.model_copy(update={"epoch": jumps.epoch, "next_sequence": 0})
            if page.next_sequence > jumps.next_sequence:  # the journal is not what it was, and will be renewed
                return
            if self._resequence:
                jumps.restart(jumps.epoch, page.next_sequence)
        elif self._resequence or page.epoch != jumps.epoch != 0:
            if page.epoch != jumps.epoch != 0:
                self._want_all(page.tick)
            jumps.restart(page.epoch, page.next_sequence)
        self._resequence = False
        self._note_head(page.epoch, page.next_sequence, -1)
        self._pages.append(page)
        self._place_pages()

    def _begin(self, tick: int) -> None:
        """The first tick heard: at the mission's first one phi is known to be 1 everywhere."""
        if tick == 0:
            self.known = self.whole = True
            return
        self.replica.tick = tick + 1  # states of this tick may have been missed
        self._resequence = True
        self._want_all(tick + 1)

    def _note_head(self, epoch: int, next_sequence: int, done: int) -> None:
        if self._authority or epoch == 0:
            return
        jumps = self.replica.jumps
        if epoch != self._head_epoch:
            self._head_epoch, self._head_sequence, self._done = epoch, 0, -1
            if jumps.epoch == 0:
                jumps.epoch = epoch
            elif epoch != jumps.epoch:
                self._want_all(self._now + 1)
        self._head_sequence = max(self._head_sequence, next_sequence)
        self._done = max(self._done, done)

    # --- integrating ---------------------------------------------------------------------------------------------

    def is_ready(self, tick: int, gone: Collection[str]) -> bool:
        """Whether all that ``tick`` needs is in. ``gone``: roles that are not waited for."""
        if tick < self.replica.tick:
            return True
        told = (*self._lives.get(tick, self._live), *self._aground.get(tick, ()))
        waited_for = [drone for drone in told if f"drone/{drone}" not in gone]
        return self.log.has_all(tick, waited_for) and (self._has_jumps(tick) or "ground" in gone)

    def _has_jumps(self, tick: int) -> bool:
        jumps = self.replica.jumps
        promised = jumps.epoch == self._head_epoch and self._done >= tick
        return self._authority or (promised and jumps.next_sequence >= self._head_sequence)

    def integrate(self, now: int, gone: Collection[str], wait_ticks: int) -> list[Integrated]:
        """Advance phi as far as can be, at most up to and including tick ``now``."""
        behind = now - self.replica.tick > TOO_FAR_BEHIND_TICKS
        if behind and not self._authority and "ground" not in gone:  # without it, what is left is all there is
            log.warning("phi is %d ticks behind and is fetched anew", now - self.replica.tick)
            self.replica.tick = now + 1
            self._want_all(now + 1)
        steps = []
        while self.replica.tick <= now:
            ready = self.is_ready(self.replica.tick, gone)
            if not ready and now - self.replica.tick < wait_ticks:
                break
            steps.append(self._advance(now))
        return steps

    def _advance(self, now: int) -> Integrated:
        tick = self.replica.tick
        live = self._lives.get(tick, self._live)
        ids, poses = self.log.poses_at(tick, live)
        self.lost += len(live) - len(ids)
        row = ids.index(self._own) if tick == now and self._own in ids else -1
        terms = self.replica.advance(tick, poses, self._mission.tick_s, row, jumps=not self._resequence)
        self.log.forget_before(tick)
        self._lives = {known: live for known, live in self._lives.items() if known > tick}
        standing, places = self.log.poses_at(tick, self._aground.get(tick, ()))
        self._aground = {known: aground for known, aground in self._aground.items() if known > tick}
        self._place_pages()
        if self.whole:
            self._sketch()
        for reached in [entry for entry in self._reached if entry[0] <= self.replica.tick]:
            self._reached.remove(reached)
            reached[1]()
        return Integrated(tick, ids, poses, terms if row >= 0 else None, dict(zip(standing, places, strict=True)))

    def newest(self) -> tuple[int, Floats]:
        """Row of the own drone in the newest poses (drones, 5) of all live ones; its own state must have been heard."""
        ids, poses = self.log.newest({*self._live, self._own})
        return ids.index(self._own), poses

    def terms(self) -> SamplingTerms:
        """Of the own drone, with phi as far as it is integrated and the newest poses."""
        row, poses = self.newest()
        return self.replica.field.terms(poses, row)

    # --- comparing, fetching, serving ----------------------------------------------------------------------------

    def _sketch(self) -> None:
        """What is due of this process's phi."""
        replica = self.replica
        for blocks in replica.layout.parts_due(replica.tick, self._digest_ticks):
            sketch = replica.layout.sketch(replica.field.phi, replica.tick, blocks)
            self._sketches[replica.tick, blocks.start] = sketch
            self._compare(replica.tick, blocks.start)

    def take_digests(self) -> list[PhiDigest]:
        """The newest of this process's phi, of each part that is not taken yet."""
        newest = {first: (tick, sketches) for (tick, first), sketches in self._sketches.items()}
        self._sketches.clear()
        epoch = self.replica.jumps.epoch
        return [
            PhiDigest(epoch=epoch, tick=tick, sketches=sketches, first_block=first)
            for first, (tick, sketches) in newest.items()
        ]

    def _compare(self, tick: int, first: int) -> None:
        """Find the blocks that differ from the ground station's, once both sketches of ``tick`` are there."""
        digest, sketch = self._digests.get((tick, first)), self._sketches.get((tick, first))
        if digest is not None and sketch is not None:
            tolerance = self._mission.replication.tolerance
            differing = [first + block for block in self.replica.layout.differing(digest.sketches, sketch, tolerance)]
            if differing:
                log.info("tick %d: %d blocks of phi differ from the ground station's", tick, len(differing))
                self._wanted.update(differing)
                self._wanted_from = max(self._wanted_from, tick)
            del self._digests[tick, first]
        for kept in (self._digests, self._sketches):
            for old in [known for known in kept if known[0] < tick - HISTORY_TICKS]:
                del kept[old]

    def _want_all(self, tick: int) -> None:
        self.whole = False
        self._pages.clear()
        self._wanted = set(range(self.replica.layout.count))
        self._wanted_from = tick

    def wants(self) -> Request | None:
        """What has to be asked for now."""
        jumps = self.replica.jumps
        if not (self._authority or self._resequence):
            target = self._head_sequence if self._head_epoch == jumps.epoch else 0
            if jumps.gap is not None:
                target = max(target, jumps.gap[1])
            if jumps.next_sequence < target:
                return JournalRequest(jumps.next_sequence, target)
        wanted = self._wanted.difference(*[page.blocks.tolist() for page in self._pages])
        if not wanted:
            return None
        return BlocksRequest(tuple(sorted(wanted)[: self.replica.layout.blocks_a_page()]), self._wanted_from)

    def _place_pages(self) -> None:
        waiting = []
        for page in self._pages:
            if not self.replica.is_placeable(page):
                waiting.append(page)
            elif self.replica.reaches_back(page):
                self.replica.place(page)
                blocks = self._wanted.intersection(page.blocks.tolist())
                self._wanted -= blocks
                self.repaired += len(blocks) if self.whole else 0
            else:
                self._wanted_from = max(self._wanted_from, self._now + 1)
        self._pages = waiting
        if not self.whole and self._now >= 0 and not self._wanted:
            self.known = self.whole = True
            log.info("phi is complete at tick %d", self.replica.tick)

    def restore(self, phi: NDArray[np.float32], next_sequence: int) -> None:
        """Go on with a phi that was kept (positions, directions); jumps from ``next_sequence`` on are not in it."""
        self.replica.field.overwrite(0, phi)
        self.replica.jumps.restart(self.replica.jumps.epoch, next_sequence)
        self._resequence = False
        self._wanted.clear()
        self._pages.clear()
        self.known = self.whole = True

    def renew(self, epoch: int) -> None:
        """The authority begins an epoch without jumps; phi stays, or goes on being fetched."""
        self.replica.jumps.restart(epoch, 0)
        if not self.known:
            self._want_all(self._now + 1)

    def when_reached(self, tick: int, call: Callable[[], None]) -> None:
        """Call once all ticks before ``tick`` are integrated: exactly then, or at once when that is past."""
        if self.replica.tick >= tick:
            call()
        else:
            self._reached.append((tick, call))

    def page(self, blocks: list[int]) -> PhiPage:
        """Raises `MessageError` while phi is not complete, or for blocks that there are not."""
        if not self.whole:
            raise MessageError("phi is not complete yet")
        if not all(0 <= block < self.replica.layout.count for block in blocks):
            raise MessageError(f"there are {self.replica.layout.count} blocks of phi, asked for {blocks}")
        return self.replica.page(blocks)

    def state(self) -> ReplicaState:
        return ReplicaState(
            tick=self.replica.tick,
            epoch=self.replica.jumps.epoch,
            next_jump=self.replica.jumps.next_sequence,
            missing=0 if self.whole else len(self._wanted),
            repaired=self.repaired,
            lost=self.lost,
        )

    @property
    def refused(self) -> int:
        """Messages that fit their type, but not this mission, field or epoch."""
        return self.replica.refused + self.skewed

    @property
    def importance(self) -> float:
        return self.replica.field.importance
