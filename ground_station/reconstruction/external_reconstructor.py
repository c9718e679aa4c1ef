"""A process of the user's own makes the map (`ground_station.external_map`); here is what became of each keyframe."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np

from ground_station.external_map import ExternalMap
from ground_station.reconstruction.reconstructor import Keyframe, Mesh, Outcome, State, Statistics
from protocol.obstacle_grid import Cells, ObstacleGrid

WAITING_MAX: Final = 100_000
"""Keyframes without a map that has them; before more are, the oldest are given up: a process may be away for good."""


class ExternalReconstructor:
    """Implements `reconstructor.Reconstructor`. A keyframe counts as fused when a map came that was made with it."""

    def __init__(self, process: ExternalMap) -> None:
        self._process = process
        self._waiting: deque[tuple[int, int, int]] = deque()
        """Drone, sequence, and the place from which on a map has it."""
        self._decided: list[Outcome] = []
        """To be told by the next call of `add` or `flush`."""
        self._received = self._fused = self._unanswered = 0

    def add(self, keyframes: Sequence[Keyframe]) -> tuple[Outcome, ...]:
        place = self._process.grow()
        self._decide()
        self._received += len(keyframes)
        self._waiting += ((keyframe.drone, keyframe.sequence, place) for keyframe in keyframes)
        while len(self._waiting) > WAITING_MAX:
            self._give_up(*self._waiting.popleft())
        return (*(Outcome(one.drone, one.sequence, "waiting") for one in keyframes), *self._take_decided())

    def flush(self) -> tuple[Outcome, ...]:
        if self._waiting:
            self._process.mesh_of(self._process.grow(), last=True)
        self._decide()
        while self._waiting:
            self._give_up(*self._waiting.popleft())
        return self._take_decided()

    def mesh(self) -> Mesh:
        mesh, _ = self._process.mesh_of(self._process.grow())
        self._decide()
        return Mesh(mesh.vertices.copy(), mesh.faces.copy(), mesh.colors.copy())

    def free_cells(self, grid: ObstacleGrid) -> Cells:
        """What is vouched for: a mesh does not say what was seen free."""
        return grid.vouched.copy()

    def statistics(self) -> Statistics:
        mesh, _ = self._process.newest
        return Statistics(
            received=self._received,
            fused=self._fused,
            waiting=len(self._waiting),
            refused={"unanswered": self._unanswered} if self._unanswered else {},
            memory_bytes=mesh.size_bytes,
        )

    @property
    def lookback(self) -> int:
        """None: the process has seen them, or asks for them."""
        return 0

    def state(self) -> State:
        self._decide()
        mesh, taken = self._process.newest
        return {
            "vertices": mesh.vertices,
            "faces": mesh.faces,
            "colors": mesh.colors,
            "taken": np.array(taken),
            "waiting": np.array(self._waiting, np.int64).reshape(-1, 3),
            "counts": np.array([self._received, self._fused, self._unanswered]),
        }

    def restore(self, state: State, recent: Iterable[Keyframe]) -> None:  # noqa: ARG002  # the protocol's
        self._process.restore(Mesh(state["vertices"], state["faces"], state["colors"]), int(state["taken"]))
        self._waiting = deque(map(tuple, state["waiting"].tolist()))
        self._received, self._fused, self._unanswered = state["counts"].tolist()

    def _decide(self) -> None:
        _, taken = self._process.newest
        while self._waiting and self._waiting[0][2] <= taken:
            drone, sequence, _ = self._waiting.popleft()
            self._decided.append(Outcome(drone, sequence, "fused"))
            self._fused += 1

    def _give_up(self, drone: int, sequence: int, _place: int) -> None:
        self._decided.append(Outcome(drone, sequence, "refused", "unanswered"))
        self._unanswered += 1

    def _take_decided(self) -> tuple[Outcome, ...]:
        decided = tuple(self._decided)
        self._decided.clear()
        return decided
