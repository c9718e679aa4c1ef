"""Writes a flight to one MCAP file, and to whoever watches with Foxglove, without ever holding up the flight.

Callers only put what they have into a bounded queue; one thread turns it into bytes. When the disk is slower than the
flight, entries are dropped and counted, but in lockstep, where the caller waits. A disk that is full ends the
recording, not the flight. A killed process loses the last `FLUSH_S`: what was written before is with the system.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ground_station.reconstruction.reconstructor import Mesh
from ground_station.recording.channels import Kind, channels_of
from ground_station.recording.entries import HandOver, IntegratedTick, JumpRecord, Look
from ground_station.recording.stored import RECORDING_VERSION, StoredMission
from ground_station.recording.writer import RecordingWriter
from ground_station.results import Metrics, Summary
from protocol import messages, topics
from protocol.mission import Mission
from protocol.obstacle_grid import Cells, ObstacleGrid
from protocol.replication import Integrated
from protocol.topics import Topic
from protocol.wire import Message

log = logging.getLogger(__name__)

RECORDING_FILE: Final = "recording.mcap"
FLUSH_S: Final = 2.0
"""Longest time for which a message waits for others to fill its chunk: a single slow drone fills one in minutes."""
CLOSE_S: Final = 30.0
"""How long the end of a flight waits for a disk that is slow."""

_Entry: TypeAlias = tuple[Kind, int, object, int]
"""Kind, drone (0: none), content, log time in ns."""
_KINDS: Final[Mapping[str, Kind]] = {
    topics.STATE.key: "state",
    topics.KEYFRAME.key: "keyframe",
    topics.EVENT.key: "event",
    topics.GROUND_EVENT.key: "event",
    topics.PHASE.key: "phase",
    topics.STATUS.key: "status",
}
"""Topics that are recorded as they come."""


@dataclass(frozen=True, slots=True)
class RecordingStatistics:
    """Counts are messages since the start, of every channel that there is."""

    written: Mapping[str, int]
    dropped: Mapping[str, int]
    """There was no room in the queue, or no file to write to any more."""
    bytes: int
    """Length of the file."""
    worst_stall_s: float
    """Longest time that a caller was held up."""
    queue: int
    """Entries that wait."""
    failed: str
    """Why the recording ended before the flight; empty if it did not."""


def recording_path(folder: Path) -> Path:
    """Where the next recording of a run goes: a ground station that was started again writes a file of its own."""
    path, number = folder / RECORDING_FILE, 1
    while path.exists():
        number += 1
        path = folder / f"{Path(RECORDING_FILE).stem}-{number}.mcap"
    return path


class Recorder:
    """All methods but `close` return at once, from whatever thread; what they are given must not change."""

    def __init__(
        self,
        path: Path | None,
        mission: Mission,
        *,
        lossless: bool,
        foxglove_port: int | None = None,
        resumed: bool = False,
        wall_clock: Callable[[], datetime] = lambda: datetime.now(UTC),
    ) -> None:
        """Begin. ``path``: the new file, None for none; ``foxglove_port``: where Foxglove may watch, 0 for any free
        port, None for nowhere; ``resumed``: the ground station has flown this mission before.

        Raises:
            StorageError: the file cannot be made.
        """
        self._lossless = lossless
        self._drones = {drone.id for drone in mission.drones}
        self._epoch_ns = int(wall_clock().timestamp()) * 10**9
        self._tick_ns = mission.tick_s * 1e9
        self._mesh_ticks = max(1, round(mission.recording.mesh_period_s / mission.tick_s))
        self._next_pictures: dict[Kind, int] = {}
        self._phase: messages.MissionPhase | None = None
        self._final_mesh: Mesh | None = None
        self._last_ns = self._epoch_ns
        self._closed = False
        self._worst_stall_s = 0.0
        self._queue: queue.Queue[_Entry | None] = queue.Queue(mission.recording.queue)
        self._writer = RecordingWriter(path, mission, foxglove_port)
        self._dropped = dict.fromkeys(self._writer.written, 0)
        self._dropping = threading.Lock()
        begun = StoredMission(
            version=RECORDING_VERSION,
            resumed=resumed,
            lossless=lossless,
            epoch_ns=self._epoch_ns,
            mission=mission.model_dump(mode="json"),
        )
        self._offer("mission", begun, 0)
        self._thread = threading.Thread(target=self._work, name="recorder", daemon=True)
        if self._writer.listens:
            self._thread.start()

    @property
    def foxglove_port(self) -> int | None:
        """Where Foxglove may watch; None: nowhere."""
        return self._writer.foxglove_port

    # --- what is recorded ----------------------------------------------------------------------------------------

    def heard(self, topic: Topic[Any], message: Message, tick: int) -> None:
        """A message of one of `_KINDS`. ``tick`` is now, and counts for what carries no tick of its own.

        Phases are recorded when they change; messages of drones that are not in the mission are left out.
        """
        drone = getattr(message, "drone", 0)
        if drone and drone not in self._drones:
            return
        if isinstance(message, messages.MissionPhase):
            if message == self._phase:
                return
            self._phase = message
        if isinstance(message, messages.Keyframe) and message.depth:
            self._offer("depth", message, message.tick, drone)
        self._offer(_KINDS[topic.key], message, getattr(message, "tick", tick), drone)

    def handed_over(self, tick: int, keyframes: Sequence[messages.Keyframe]) -> None:
        """These were given to the map, in this order."""
        self._offer("hand_over", HandOver(tick, tuple(keyframes)), tick)

    def looked(self, tick: int, importance: float) -> None:
        """A map update was begun with all that was handed over before; ``importance`` is J."""
        self._offer("look", Look(tick, importance), tick)

    def integrated(self, step: Integrated) -> None:
        """phi went on by a tick."""
        self._offer("integrated", IntegratedTick(step.tick, tuple(step.ids), step.poses), step.tick)

    def jumped(self, look: int, jump: messages.Jump, tick: int) -> None:
        """``jump`` is journalled and told at ``tick``; it came of the look at tick ``look``."""
        self._offer("jump", JumpRecord(look, jump), tick)

    def mesh(self, tick: int, mesh: Mesh) -> None:
        """The newest map; recorded once in ``mission.recording.mesh_period_s``."""
        if len(mesh.faces) and self._is_due("mesh", tick):
            self._offer("mesh", mesh, tick)

    def phi(self, tick: int, phi: NDArray[np.float32]) -> None:
        """phi (positions, directions), of which each position's mean is recorded, as often as the map."""
        if self._is_due("phi", tick):
            self._offer("phi", phi.mean(axis=1, dtype=np.float32), tick)

    def free(self, tick: int, grid: ObstacleGrid, free: Cells) -> None:
        """What of ``grid`` is free; recorded as often as the map. It must not change later."""
        if self._is_due("free", tick):
            self._offer("free", (grid, free), tick)

    def metrics(self, metrics: Metrics) -> None:
        self._offer("metrics", metrics, metrics.tick)

    def finished(self, summary: Summary, mesh: Mesh) -> None:
        """The flight's end. The last map becomes an attachment too, as a PLY file."""
        if len(mesh.faces):
            self._offer("mesh", mesh, summary.final.tick)
            self._final_mesh = mesh
        self._offer("summary", summary, summary.final.tick)

    def statistics(self) -> RecordingStatistics:
        writer = self._writer
        return RecordingStatistics(
            written=dict(writer.written),
            dropped=self._losses(),
            bytes=writer.size_bytes,
            worst_stall_s=self._worst_stall_s,
            queue=self._queue.qsize(),
            failed=writer.failed,
        )

    def _losses(self) -> dict[str, int]:
        return {name: count + self._dropped[name] for name, count in self._writer.lost.items()}

    def _is_due(self, kind: Kind, tick: int) -> bool:
        due = self._writer.listens and tick >= self._next_pictures.get(kind, tick)
        if due:
            self._next_pictures[kind] = tick + self._mesh_ticks
        return due

    def _offer(self, kind: Kind, content: object, tick: int, drone: int = 0) -> None:
        if not self._writer.listens:
            return
        self._last_ns = self._epoch_ns + round(tick * self._tick_ns)
        began_s = time.perf_counter()
        if not self._put((kind, drone, content, self._last_ns)):
            with self._dropping:
                for name in channels_of(kind, drone):
                    self._dropped[name] += 1
        self._worst_stall_s = max(self._worst_stall_s, time.perf_counter() - began_s)

    def _put(self, entry: _Entry) -> bool:
        if self._closed:
            return False
        try:
            self._queue.put(entry, block=self._lossless)
        except queue.Full:
            return False
        return True

    # --- the thread ----------------------------------------------------------------------------------------------

    def _work(self) -> None:
        due_s = time.monotonic()  # the mission goes first: without it nothing else is of use
        while True:
            try:
                entry = self._queue.get(timeout=max(0.0, due_s - time.monotonic()))
            except queue.Empty:
                pass
            else:
                if entry is None:
                    break
                self._writer.write(*entry)
            if time.monotonic() >= due_s:
                self._writer.flush()
                due_s = time.monotonic() + FLUSH_S
        self._writer.complete(self._final_mesh, self._last_ns, self._losses())

    def close(self, timeout_s: float = CLOSE_S) -> None:
        """Write what waits, and end the file. May be called again."""
        if self._closed:
            return
        self._closed = True
        if not self._thread.is_alive():
            return
        try:
            self._queue.put(None, timeout=timeout_s)
        except queue.Full:
            pass  # said below
        else:
            self._thread.join(timeout_s)
        if self._thread.is_alive():
            log.error("the recording is left without its end: the disk took none of it for %g s", timeout_s)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
