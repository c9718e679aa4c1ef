"""What became of a reconstructor's keyframes: the counts of all, and the outcomes that are still to be told."""

from __future__ import annotations

from collections import Counter
from typing import Protocol, get_args

import numpy as np

from ground_station.reconstruction.reconstructor import Outcome, Refusal, State, Statistics


class Numbered(Protocol):
    """A keyframe, or what a reconstructor keeps of one."""

    @property
    def drone(self) -> int: ...
    @property
    def sequence(self) -> int: ...


class Ledger:
    def __init__(self) -> None:
        self.received = 0
        self._fused = 0
        self._refused: Counter[Refusal] = Counter()
        self._untold: list[Outcome] = []

    def fuse(self, keyframe: Numbered) -> Outcome:
        """Count it as fused."""
        self._fused += 1
        return Outcome(keyframe.drone, keyframe.sequence, "fused")

    def refuse(self, keyframe: Numbered, reason: Refusal) -> Outcome:
        """Count it as refused."""
        self._refused[reason] += 1
        return Outcome(keyframe.drone, keyframe.sequence, "refused", reason)

    def note(self, outcome: Outcome) -> None:
        """Keep it for the next `take`."""
        self._untold.append(outcome)

    def take(self) -> tuple[Outcome, ...]:
        """All that was noted since the last time, in that order."""
        untold = tuple(self._untold)
        self._untold.clear()
        return untold

    def statistics(self, memory_bytes: int) -> Statistics:
        return Statistics(
            received=self.received,
            fused=self._fused,
            waiting=self.received - self._fused - self._refused.total(),
            refused=dict(self._refused),
            memory_bytes=memory_bytes,
        )

    def state(self) -> State:
        return {
            "fused": np.array(self._fused),
            "refused": np.array([self._refused[reason] for reason in get_args(Refusal)]),
        }

    def restore(self, state: State, waiting: int) -> None:
        """``waiting``: how many are neither fused nor refused yet."""
        self._fused = int(state["fused"])
        self._refused = +Counter(dict(zip(get_args(Refusal), state["refused"].tolist(), strict=True)))  # without zeros
        self.received = self._fused + self._refused.total() + waiting
