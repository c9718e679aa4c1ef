"""What the agent asks of any method that decides where a drone flies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from agents.barriers import Neighbour, Rows
from agents.obstacles import Obstacles
from agents.quadratic_program import Outcome
from protocol.geometry import Floats
from protocol.importance import SamplingTerms

STAY: Floats = np.zeros(5)


@dataclass(frozen=True, slots=True)
class Decision:
    """The velocity to fly and why."""

    velocity: Floats
    """(5,) m/s and rad/s, world frame."""
    outcome: Outcome
    slack: float
    sampling: float
    """I_i = sum of delta_1 h1 phi over the drone's own cells, 1/s, whatever the planner goes by."""
    rows: Rows
    active: tuple[str, ...]


class Planner(Protocol):
    """Every planner flies behind the same strict rows (`agents.planners.safety_filter`)."""

    def heed(self, obstacles: Obstacles) -> None:
        """There is a map of free cells, and it is kept up to date: what is not free is behind strict rows too."""
        ...

    def note_deviation(self, deviation_m: float) -> None:
        """Standard deviation of the own position, from now on: the strict rows of box, boundary and zones keep so much
        farther away. Neighbours and obstacles come with theirs."""
        ...

    def note_team(self, drones: Sequence[int], poses: Floats) -> None:
        """One tick of phi was integrated with these ``drones``, ascending by id, at ``poses`` (drones, 5)."""
        ...

    def decide(
        self, pose: Floats, velocity: Floats, neighbours: Sequence[Neighbour], terms: SamplingTerms, cells: float
    ) -> Decision:
        """Own ``pose`` and ``velocity`` (5,); phi's ``terms``; ``cells`` = |V_i|."""
        ...

    def steer(self, pose: Floats, velocity: Floats, neighbours: Sequence[Neighbour], wish: Floats = STAY) -> Decision:
        """Fly ``wish`` (5,), as far as the strict rows allow; they may also make a drone that stays give way."""
        ...

    def rehearse(self) -> None:
        """Decide once at no place in particular, so that nothing is left to be compiled in flight. Such a planner is
        not to be flown with any more."""
        ...
