"""A recording in memory: what the ground station tells its recorder, as the entries that a reader would give."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ground_station.reconstruction.reconstructor import Mesh
from ground_station.recording.entries import HandOver, Input, IntegratedTick, JumpRecord, Look
from ground_station.recording.recorder import RecordingStatistics
from ground_station.results import Metrics, Summary
from protocol import messages
from protocol.obstacle_grid import Cells, ObstacleGrid
from protocol.replication import Integrated
from protocol.topics import Topic
from protocol.wire import Message


class RecordedFlight:
    """The `ground_station.recording.recorder.Recorder` that the tests put in its place: it needs no thread."""

    def __init__(self) -> None:
        self.inputs: list[Input] = []
        self.summary: dict[str, Any] = {}

    @property
    def jumped_looks(self) -> list[int]:
        """Ticks of the looks that made phi jump."""
        return [entry.look for entry in self.inputs if isinstance(entry, JumpRecord)]

    def handed_over(self, tick: int, keyframes: Sequence[messages.Keyframe]) -> None:
        self.inputs.append(HandOver(tick, tuple(keyframes)))

    def looked(self, tick: int, importance: float) -> None:
        self.inputs.append(Look(tick, importance))

    def integrated(self, step: Integrated) -> None:
        self.inputs.append(IntegratedTick(step.tick, tuple(step.ids), np.array(step.poses)))

    def jumped(self, look: int, jump: messages.Jump, tick: int) -> None:  # noqa: ARG002  # the recorder's
        self.inputs.append(JumpRecord(look, jump))

    def finished(self, summary: Summary, mesh: Mesh) -> None:  # noqa: ARG002  # likewise
        self.summary = summary.as_json()

    # What is recorded for people is not kept.

    def heard(self, topic: Topic[Any], message: Message, tick: int) -> None: ...
    def mesh(self, tick: int, mesh: Mesh) -> None: ...
    def phi(self, tick: int, phi: NDArray[np.float32]) -> None: ...
    def free(self, tick: int, grid: ObstacleGrid, seen: Cells) -> None: ...
    def metrics(self, metrics: Metrics) -> None: ...
    def close(self) -> None: ...

    def statistics(self) -> RecordingStatistics:
        return RecordingStatistics(written={}, dropped={}, bytes=0, worst_stall_s=0.0, queue=0, failed="")
