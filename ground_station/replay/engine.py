"""The ground station driven by a recording instead of by drones: the same map, the same feedback, the same phi.

What the flight decided by the clock on the wall is taken from the recording: which keyframes were handed to the map
together, when the map was looked at, and when a jump took effect. Everything else is computed anew.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ground_station.evaluation import Scores
from ground_station.feedback import FeedbackSchedule
from ground_station.map_feedback import SCORE_PERIOD_S
from ground_station.mapper import Mapper, MapUpdate
from ground_station.recording.entries import HandOver, Input, IntegratedTick, JumpRecord, Look
from ground_station.replay.comparison import Comparison
from ground_station.results import Metrics
from protocol.field import VirtualField
from protocol.importance import ImportanceField
from protocol.messages import Jump
from protocol.mission import Mission
from protocol.replica import Replica

EPOCH = 1
"""Of the replay's own jumps; any that is not 0."""


@dataclass(frozen=True, slots=True, eq=False)
class _Update:
    """A map update that was computed, and waits for the tick at which the flight would have had it."""

    look: int
    effective: int
    increments: NDArray[np.float32] | None
    scores: Scores | None


class Replay:
    def __init__(self, flown: Mission, mission: Mission, mapper: Mapper, jumped: Collection[int]) -> None:
        """``mission`` is ``flown``, or that with other settings; ``jumped`` are the ticks of the looks at the map that
        made phi jump in flight."""
        self._mission, self._mapper = mission, mapper
        self._schedule = FeedbackSchedule(mission.feedback, mission.tick_s)
        self._faithful = mission == flown
        timing, timing_flown = ((each.feedback.period_s, each.feedback.delay_s) for each in (mission, flown))
        self._timed_as_flown = timing == timing_flown
        self._jumped = frozenset(jumped if self._timed_as_flown else ())
        self._replica = Replica(ImportanceField(VirtualField.of(mission.target), mission.sensing), EPOCH)
        self._updates: deque[_Update] = deque()
        self._held: NDArray[np.float32] | None = None
        self._scored_at = -math.inf
        self._scores: Scores | None = None
        self._keyframes = 0
        self.comparison = Comparison()
        """With the flight; of interest while nothing but the mission's feedback or reconstruction was changed."""

    @property
    def field(self) -> ImportanceField:
        return self._replica.field

    @property
    def tick(self) -> int:
        """The newest that is integrated; -1 before the first."""
        return self._replica.tick - 1

    def metrics(self) -> Metrics:
        """As the flight's at the same tick."""
        return Metrics(
            time_s=self.tick * self._mission.tick_s,
            tick=self.tick,
            importance=self.field.importance,
            scores=self._scores,
            jumps=self._replica.jumps.next_sequence,
            keyframes=self._keyframes,
        )

    def feed(self, entry: Input) -> None:
        """Do what the flight did next."""
        match entry:
            case HandOver():
                self._hand_over(entry)
            case IntegratedTick():
                self._integrate(entry)
            case Look():
                self.comparison.look(entry.tick, entry.importance, self.field.importance)
                if self._timed_as_flown:
                    self._look(entry.tick)
            case JumpRecord():
                self._jump(entry)

    def finish(self) -> MapUpdate:
        """The complete map, scored if a truth is known."""
        result = self._mapper.finish()
        self._scores = result.scores or self._scores
        return result

    def _hand_over(self, entry: HandOver) -> None:
        if entry.missing:
            self.comparison.note(entry.tick, f"the recording lacks {len(entry.missing)} keyframes that the map has")
        self._keyframes += len(entry.keyframes) + len(entry.missing)
        self._mapper.add(entry.keyframes)

    def _integrate(self, entry: IntegratedTick) -> None:
        if entry.tick != self.tick + 1:
            self.comparison.note(self.tick + 1, f"the recording goes on with tick {entry.tick}")
        self._settle(entry.tick)
        # A copy of its own: numba compiles another kernel for arrays that are read-only.
        self._replica.advance(entry.tick, np.array(entry.poses, np.float64, order="C"), self._mission.tick_s)
        if not self._timed_as_flown and self._schedule.is_due(entry.tick):
            self._look(entry.tick)

    def _look(self, tick: int) -> None:
        time_s = tick * self._mission.tick_s
        scored = time_s - self._scored_at >= SCORE_PERIOD_S
        if scored:
            self._scored_at = time_s
        result = self._mapper.update(scored=scored)
        increments = self._schedule.increments(result.change, self.field.importance)
        self._updates.append(_Update(tick, self._schedule.effective_tick(tick), increments, result.scores))

    def _settle(self, tick: int) -> None:
        """Let the updates jump that are about to take effect, but for those whose time the recording tells."""
        while self._updates and self._updates[0].effective <= tick + 1 and self._updates[0].look not in self._jumped:
            self._take(self._updates.popleft())

    def _take(self, update: _Update) -> None:
        """An update from which the flight had no jump."""
        self._scores = update.scores or self._scores
        if update.increments is None:
            return
        if self._faithful:  # it was refused by the disk, and added to the next one, or came too late
            self._held = update.increments if self._held is None else update.increments + self._held
        else:
            self._publish(update.increments, update.effective)

    def _jump(self, entry: JumpRecord) -> None:
        while self._updates and self._updates[0].look < entry.look:
            self._take(self._updates.popleft())
        replayed = None
        if self._updates and self._updates[0].look == entry.look and entry.look in self._jumped:
            update = self._updates.popleft()
            self._scores = update.scores or self._scores
            if update.increments is not None:
                held, self._held = self._held, None
                increments = update.increments if held is None else update.increments + held
                replayed = self._publish(increments, entry.jump.tick)
        self.comparison.jump(entry.look, entry.jump, replayed)

    def _publish(self, increments: NDArray[np.float32], tick: int) -> Jump:
        jump = Jump(epoch=EPOCH, sequence=self._replica.jumps.next_sequence, tick=tick, increments=increments)
        self._replica.hear(jump)
        return jump
