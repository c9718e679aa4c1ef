"""When the map is looked at, and whether its change makes phi jump: eq. (4) with the J gate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protocol.map_settings import Feedback


class FeedbackSchedule:
    """Map updates in ticks of the mission; the same ticks in every run of the same mission."""

    def __init__(self, feedback: Feedback, tick_s: float) -> None:
        self._feedback = feedback
        self._period = max(1, round(feedback.period_s / tick_s))
        self._delay = max(1, round(feedback.delay_s / tick_s))

    def is_due(self, tick: int) -> bool:
        """Whether the map is compared with the one before at this tick."""
        return tick > 0 and tick % self._period == 0

    def effective_tick(self, tick: int) -> int:
        """When a jump from the map of ``tick`` is applied, in every process."""
        return tick + self._delay

    def settled_after(self, tick: int) -> int:
        """The last tick that no map update of a tick after ``tick`` can change any more."""
        return self.effective_tick((tick // self._period + 1) * self._period) - 1

    def increments(self, change: NDArray[np.float32], importance: float) -> NDArray[np.float32] | None:
        """delta_2 h2 per position; None while J >= J_th, without gain, or when nothing changed.

        ``change`` is h2 (positions,), ``importance`` J at the tick that the map belongs to.
        """
        if self._feedback.method == "none" or importance >= self._feedback.threshold or not change.any():
            return None
        return np.float32(self._feedback.gain) * change if self._feedback.gain > 0 else None
