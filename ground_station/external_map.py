"""The map of another process: gives it keyframes as it asks for them, and judges the meshes that it answers with.

Between the event loop, on which the process is heard, and the map's thread, which waits for it in lockstep: never long,
and not again before a process that was late has answered. Nothing else of the mission depends on its answers.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Final

import numpy as np

from ground_station.keyframe_log import KeyframeLog
from ground_station.reconstruction.reconstructor import Mesh
from protocol.errors import MessageError
from protocol.messages import EventLevel, ExternalMesh, KeyframePage
from protocol.mission import Box, Mission
from protocol.news import Tell

PAGE_BYTES: Final = 4 * 2**20
"""Of keyframes: some hundred of them."""
ANSWER_S: Final = 1.0
"""A question waits so long for something new."""
LIFE_S: Final = 0.1
"""How often whoever waits for a map looks whether its process still lives."""
_KINDS: Final = (("vertices", np.float32), ("faces", np.int32), ("colours", np.uint8))


class ExternalMap:
    """`answer` and `hear` are called in the event loop; `grow`, `newest` and `mesh_of` from the map's thread."""

    def __init__(self, mission: Mission, log: KeyframeLog, epoch: int, *, lockstep: bool) -> None:
        """``epoch``: identity of ``log``, the same when this process comes back to it."""
        self._box: Box = mission.target
        self._patience_s = mission.reconstruction.external_patience_s
        self._log, self._epoch, self._lockstep = log, epoch, lockstep
        self._end = log.end
        """Behind the last keyframe of the map; places are positions in the log."""
        self._asked = 0
        """Up to where a map was asked for, and ..."""
        self._wanted = False
        """... whether it is still to come."""
        self._newest, self._taken = Mesh.empty(), 0
        self._was_there = self._gave_up = False
        self._said = ""
        self._changed = threading.Condition()
        self._work = asyncio.Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._tell: Tell = lambda _level, _kind, _text: None
        self._lives: Callable[[], bool] = lambda: False
        self.refused = 0
        """Meshes that are none."""

    def join(self, tell: Tell, lives: Callable[[], bool]) -> None:
        """In the event loop, first of all: who hears what happens, and whether the process lives; from any thread."""
        self._loop, self._tell, self._lives = asyncio.get_running_loop(), tell, lives

    # --- in the event loop ---------------------------------------------------------------------------------------

    async def answer(self, parameters: dict[str, str]) -> KeyframePage:
        """To ``epoch=7;from=120``, as soon as there is something new. Raises `MessageError` if these are no numbers."""
        try:
            epoch, first = int(parameters.get("epoch", 0)), int(parameters.get("from", 0))
        except ValueError as error:
            raise MessageError(f"map: epoch and from must be numbers: {parameters}") from error
        if epoch != self._epoch or not 0 <= first <= self._end:
            first = 0
        self._work.clear()
        if first == self._end and not self._wanted:
            with suppress(TimeoutError):
                await asyncio.wait_for(self._work.wait(), ANSWER_S)
        end = self._end
        keyframes, following = await asyncio.to_thread(self._log.page, first, end, PAGE_BYTES)
        wanted = self._wanted and following == end
        return KeyframePage(epoch=self._epoch, first=first, next=following, keyframes=tuple(keyframes), wanted=wanted)

    def hear(self, message: ExternalMesh) -> None:
        """Take the map, or refuse it and say why."""
        if message.epoch != self._epoch:
            return
        fault = fault_of(message, self._box)
        with self._changed:
            if fault:
                self.refused += 1
            elif message.taken >= self._taken:
                self._newest, self._taken = Mesh(message.vertices, message.faces, message.colours), message.taken
            self._gave_up = False
            if message.taken >= self._asked:
                self._wanted = False
                self._changed.notify_all()
        self._say(f"the external map is refused: {fault}" if fault else "")

    # --- on the map's thread -------------------------------------------------------------------------------------

    def grow(self) -> int:
        """Let the process have all that is in the log by now; the place behind it."""
        self._end = self._log.end
        self._wake()
        return self._end

    def restore(self, mesh: Mesh, taken: int) -> None:
        """Of an earlier life, until the process answers."""
        self._newest, self._taken = mesh, taken

    @property
    def newest(self) -> tuple[Mesh, int]:
        """The newest map, and the place before which all keyframes are in it."""
        with self._changed:
            return self._newest, self._taken

    def mesh_of(self, end: int, *, last: bool = False) -> tuple[Mesh, int]:
        """`newest`, in lockstep and when it is the ``last`` one that of all keyframes before ``end``, if it comes in
        time; in real time it comes for the next call."""
        with self._changed:
            self._asked, self._wanted = end, self._taken < end
        if self._wanted:
            self._wake()
            if last or (self._lockstep and not self._gave_up):
                self._wait()
            elif not (self._gave_up or self._lives()):
                self._say("the external map's process is away: no map updates until it is there")
        return self.newest

    def _wait(self) -> None:
        deadline = time.monotonic() + self._patience_s
        with self._changed:
            while self._wanted:
                lives = self._lives()
                self._was_there |= lives
                left_s = deadline - time.monotonic()
                if left_s <= 0 or (self._was_there and not lives):
                    self._gave_up = True
                    break
                self._changed.wait(min(left_s, LIFE_S))
            gave_up = self._wanted
        if not gave_up:
            return
        what = "was late" if self._lives() else "is gone" if self._was_there else "has not come"
        waited = "" if what == "is gone" else f" in {self._patience_s:g} s"
        luck = ", and this run cannot be repeated" if self._lockstep else ""
        self._say(f"the external map's process {what}{waited}: no map updates until it answers{luck}")

    def _wake(self) -> None:
        if self._loop is not None:
            with suppress(RuntimeError):  # closed
                self._loop.call_soon_threadsafe(self._work.set)

    def _say(self, fault: str) -> None:
        """Once, and once more when it is over."""
        if fault == self._said:
            return
        self._said = fault
        level: EventLevel = "warning" if fault else "info"
        self._tell(level, "map", fault or "the external map's process answers")


def fault_of(message: ExternalMesh, box: Box) -> str:
    """Why its arrays are no map of ``box``; empty if they are."""
    if message.fault:
        return message.fault
    for name, kind in _KINDS:
        array = getattr(message, name)
        if array.dtype != kind or array.ndim != 2 or array.shape[1] != 3:
            return f"{name} are {array.dtype} {array.shape}, must be {np.dtype(kind)} (n, 3)"
    vertices, faces = message.vertices, message.faces
    if len(message.colours) != len(vertices):
        return f"{len(message.colours)} colours of {len(vertices)} vertices"
    if len(faces) and not 0 <= int(faces.min()) <= int(faces.max()) < len(vertices):
        return f"faces name vertices from {faces.min()} to {faces.max()}, there are {len(vertices)}"
    inside = ((vertices >= np.array(box.lower_m)) & (vertices <= np.array(box.upper_m))).all(axis=1)
    if len(vertices) and not inside.any():
        return "no vertex lies in the target: another frame, or another unit than metres"
    return ""
