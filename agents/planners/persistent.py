"""Persistent coverage: importance returns where nobody looks, so nobody is ever done.

Source: H. Dan, J. Yamauchi, T. Hatanaka, M. Fujita, "Control Barrier Function-Based Persistent Coverage with
Performance Guarantee and Application to Object Search Scenario", IEEE CCTA (2020), as Coverage-Recon compares with it.
Taken from it: drones in a plane of fixed height with their cameras straight down; a planar field of importance that
falls where a camera looks and grows back to 1 where none does; each drone answers for the cells that are its own; a
quadratic program that keeps a certificate of performance, softly, behind strict rows for safety. Ours: the certificate
is that of Coverage-Recon's eq. (15), with the growth in its time derivative; sensing is h1 of eq. (1) without direction
of view; the strict rows are those of all planners, and no object is searched for.

The field is this planner's own: cells at D below the drones, as large as those of phi. Every process integrates it from
the states that phi is integrated with, so a team without losses agrees on it; one that starts late begins with 1
everywhere, and agrees again after some 1/regrowth. How well the mission goes is judged by phi alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from agents.barriers import Neighbour
from agents.planners.coverage import sampling_row
from agents.planners.downward import DownwardPlanner
from agents.planners.planner import Decision
from protocol.field import VirtualField
from protocol.geometry import Floats
from protocol.importance import ImportanceField, SamplingTerms
from protocol.mission import Mission

_UPWARD = np.array([[0.0, 0.0, 1.0]])


class PersistentCoverage(DownwardPlanner):
    def __init__(self, mission: Mission, drone: int, neighbours: int) -> None:
        super().__init__(mission, neighbours)
        self._drone = drone
        self._field = _planar_field(mission)
        self._unseen = _planar_field(mission)  # stays 1 everywhere: its terms are sums of h1 alone
        self._kept = math.exp(-mission.planners.regrowth_per_s * mission.tick_s)
        self._team: dict[int, Floats] = {}

    @property
    def importance(self) -> Floats:
        """Of the planner's own field, (x cells, y cells)."""
        field = self._field.field
        return self._field.phi.reshape(len(field.xs), len(field.ys)).astype(np.float64)

    def note_team(self, drones: Sequence[int], poses: Floats) -> None:
        """Decay and growth over one tick: phi' = -delta_1 max h1 phi + regrowth (1 - phi), one after the other."""
        self._team = dict(zip(drones, poses, strict=True))
        self._field.advance(poses, self._mission.tick_s)
        grown = 1 - self._kept * (1 - self._field.phi)
        self._field.overwrite(0, grown.astype(np.float32))

    def decide(
        self,
        pose: Floats,
        velocity: Floats,
        neighbours: Sequence[Neighbour],
        terms: SamplingTerms,
        cells: float,  # noqa: ARG002  # counted on the planner's own field
    ) -> Decision:
        xi1, xi2 = self._certificate(pose)
        return self._pursue(pose, velocity, neighbours, xi1, xi2, self._mission.sensing.decay_per_s * terms.first)

    def _certificate(self, pose: Floats) -> tuple[Floats, float]:
        """xi1 (5,) and xi2 of the planner's own field, with the growth's part of db/dt in xi2."""
        team = self._team | {self._drone: pose}
        drones = sorted(team)
        poses, row = np.array([team[drone] for drone in drones]), drones.index(self._drone)
        own, sensed = self._field.terms(poses, row), self._unseen.terms(poses, row)
        settings, cells = self._mission.planners, float(self._field.owned_cells(poses)[row])
        xi1, xi2 = sampling_row(self._mission, own, cells * settings.persistent_rate_per_s)
        growth = settings.regrowth_per_s * (sensed.first - own.first)
        return xi1, xi2 + self._mission.sensing.decay_per_s * growth


def _planar_field(mission: Mission) -> ImportanceField:
    """One layer of cells, each to be seen from above, from however far aside."""
    lattice = VirtualField.of(mission.target)
    height = np.array([mission.planners.altitude_m - mission.sensing.distance_m])
    layer = VirtualField(lattice.xs, lattice.ys, height, _UPWARD)
    # Without a bound on the direction of view its factor of h1 is exp(0).
    return ImportanceField(layer, mission.sensing.model_copy(update={"sigma_view": math.inf}))
