"""A map that changes by a script instead of by images: so phi jumps often, and every jump can be counted in phi."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ground_station.evaluation import Scores
from ground_station.mapper import MapState, MapUpdate
from ground_station.reconstruction.reconstructor import Mesh
from protocol import messages
from protocol.field import VirtualField
from protocol.obstacle_grid import Cells, ObstacleGrid

MARK = np.float32(2.0**-6)
"""What each update adds at the marked positions: a power of two, whose sums float32 holds exactly."""
HIGHEST = 0.3
"""Of a change at other positions."""
REACH_M = 0.5


class ScriptedMapper:
    """The `ground_station.mapper.Mapper` that the tests put in its place.

    The highest layer of positions lies above the drones, whose cameras look down: it never decays. Each update raises
    it by MARK, and a random place below it by up to HIGHEST.
    """

    def __init__(self, field: VirtualField, seed: int) -> None:
        self._positions = field.positions()
        self._marked = marked(field)
        self._seed = seed
        self._updates = 0
        self.taken = self.refused = self.unlocated = self.memory_bytes = 0
        self.feedback_update_s = None
        """Nothing is compared here."""

    def add(self, keyframes: Sequence[messages.Keyframe]) -> None:
        """Images say nothing here."""

    def keep(self, keyframes: Sequence[messages.Keyframe]) -> None:
        """Nothing is logged here."""

    def update(self, *, scored: bool) -> MapUpdate:
        del scored
        self._updates += 1
        dice = np.random.default_rng([self._seed, self._updates])
        centre = dice.uniform(self._positions.min(axis=0), self._positions.max(axis=0))
        square = np.square(self._positions - centre).sum(axis=1)
        change = (dice.uniform(0.0, HIGHEST) * np.exp(-square / (2 * REACH_M**2))).astype(np.float32)
        change[self._marked] = MARK
        return MapUpdate(Mesh.empty(), change, None)

    def free_cells(self, grid: ObstacleGrid) -> Cells:
        """A script sees nothing."""
        return grid.vouched.copy()

    def state(self) -> MapState:
        return MapState({"updates": np.array([self._updates], np.int32)}, first=0, end=0, unreadable=0)

    def restore(self, state: MapState | None) -> int:
        """Go on with the script; no image was mapped again."""
        if state is not None:
            self._updates = int(state.reconstruction["updates"][0])
        return 0

    def finish(self) -> MapUpdate:
        return MapUpdate(Mesh.empty(), np.zeros(len(self._positions), np.float32), None)

    def floor_scores(self) -> Scores | None:
        return None


def marked(field: VirtualField) -> NDArray[np.bool_]:
    """(positions,) those of the highest layer."""
    heights = field.positions()[:, 2]
    marks: NDArray[np.bool_] = heights == heights.max()
    return marks
