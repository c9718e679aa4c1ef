"""How far drones are from where they believe to be, where a simulator tells the truth: to judge by, never to fly by."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from protocol.messages import Tick

KEPT_TICKS = 200
"""How long a truth waits for its tick to be integrated: longer than `Replication.wait_s` allows."""


@dataclass(frozen=True, slots=True)
class PoseErrorFigures:
    """Of all drones and ticks, metres and radians."""

    rms_m: float
    max_m: float
    final_m: float
    """The largest at the last tick."""
    yaw_rms_rad: float
    beyond: float
    """Share of them that were larger than `protocol.separation.SIGMAS` told standard deviations."""


class PoseErrors:
    def __init__(self) -> None:
        self._truths: dict[int, dict[int, Sequence[float]]] = {}
        self._count = self._beyond = 0
        self._squares = self._yaw_squares = self._max_m = self._final_m = 0.0

    def hear(self, tick: Tick) -> None:
        truths = {sample.drone: sample.truth for sample in tick.vehicles if sample.truth is not None}
        if truths:
            self._truths[tick.tick] = dict(truths)
            for old in [known for known in self._truths if known <= tick.tick - KEPT_TICKS]:
                del self._truths[old]

    def truth(self, tick: int) -> Mapping[int, Sequence[float]]:
        """True poses at ``tick`` by drone; empty where they are not told."""
        return self._truths.get(tick, {})

    def note(self, tick: int, poses: Mapping[int, Sequence[float]], allowed_m: Mapping[int, float]) -> None:
        """What the drones believed at ``tick``, and how far it may be off by what they tell of it."""
        errors = []
        for drone, truth in self.truth(tick).items():
            if drone in poses:
                error_m = math.dist(truth[:3], poses[drone][:3])
                errors.append(error_m)
                self._yaw_squares += math.remainder(poses[drone][3] - truth[3], math.tau) ** 2
                self._beyond += error_m > allowed_m.get(drone, math.inf)
        if errors:
            self._count += len(errors)
            self._squares += sum(error * error for error in errors)
            self._final_m = max(errors)
            self._max_m = max(self._max_m, self._final_m)

    @property
    def figures(self) -> PoseErrorFigures | None:
        """None where no truth was told."""
        if not self._count:
            return None
        return PoseErrorFigures(
            math.sqrt(self._squares / self._count),
            self._max_m,
            self._final_m,
            math.sqrt(self._yaw_squares / self._count),
            self._beyond / self._count,
        )
