"""A process that makes the map, as far as the ground station can tell: the real one's parts, on a thread."""

from __future__ import annotations

import asyncio
import io
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from PIL import Image

from ground_station.external_map import ExternalMap
from ground_station.keyframe_log import KeyframeLog
from ground_station.reconstruction.external_reconstructor import ExternalReconstructor
from ground_station.reconstruction.reconstructor import Keyframe, Outcome
from protocol import messages
from protocol.depth_image import encode_depth
from protocol.external_map import MapMaker, MapProcess
from protocol.keyframe_rule import make_keyframe
from protocol.mission import Mission
from protocol.queries import parse_parameters

EPOCH = 7
END_S = 10.0


def as_message(keyframe: Keyframe) -> messages.Keyframe:
    jpeg = io.BytesIO()
    Image.fromarray(keyframe.image).save(jpeg, "JPEG", quality=95)
    return make_keyframe(
        keyframe.drone,
        keyframe.sequence,
        keyframe.tick,
        keyframe.position,
        keyframe.rotation,
        keyframe.intrinsics,
        jpeg.getvalue(),
        encode_depth(keyframe.depth) if keyframe.depth is not None else b"",
    )


class LoggedReconstructor(ExternalReconstructor):
    """Puts what it is given into the log first, as the ground station's mapper does."""

    def __init__(self, process: ExternalMap, log: KeyframeLog) -> None:
        super().__init__(process)
        self._log = log

    def add(self, keyframes: Sequence[Keyframe]) -> tuple[Outcome, ...]:
        for keyframe in keyframes:
            self._log.append(as_message(keyframe))
        return super().add(keyframes)


@contextmanager
def served(mission: Mission, folder: Path, make: Callable[[], MapMaker]) -> Iterator[Callable[[], LoggedReconstructor]]:
    """Reconstructors, each of which is another life of the ground station with the same process and log."""
    maps: list[ExternalMap] = []
    ended = threading.Event()

    async def serve() -> None:
        process, joined = MapProcess(make), 0
        while not ended.is_set():
            for newcomer in maps[joined:]:
                newcomer.join(lambda *_: None, lambda: not ended.is_set())
                joined += 1
            if not maps:
                await asyncio.sleep(0.001)
                continue
            newest = maps[-1]
            try:
                page = await asyncio.wait_for(newest.answer(parse_parameters(process.question)), 0.05)
            except TimeoutError:
                continue
            mesh = process.take(page)
            if mesh is not None:
                newest.hear(mesh)

    thread = threading.Thread(target=asyncio.run, args=(serve(),), daemon=True)
    thread.start()
    with KeyframeLog(folder / "keyframes") as log:

        def life() -> LoggedReconstructor:
            maps.append(ExternalMap(mission, log, EPOCH, lockstep=True))
            return LoggedReconstructor(maps[-1], log)

        try:
            yield life
        finally:
            ended.set()
            thread.join(END_S)
