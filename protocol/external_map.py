"""All that a process needs that makes the map in the ground station's place: docs/external-reconstructor.md.

It asks for keyframes at its own pace and is told when a map of them is waited for. The ground station has the list of
all keyframes on disk, so either of the two may die and come back: a new process begins with the first keyframe.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from protocol import topics
from protocol.bus import Bus, connect
from protocol.errors import NoReply
from protocol.messages import ExternalMesh, Keyframe, KeyframePage
from protocol.mission import Mission
from protocol.process import Arguments, run_process
from protocol.wire import decode, encode

log = logging.getLogger(__name__)

ROLE = "mapper"
ASK_TIMEOUT_S = 5.0
"""For one page; the ground station answers within a second, on an idle link."""
RETRY_S = 0.2
"""After a question that nobody answered."""
FAULT_LETTERS = 500


@dataclass(frozen=True, slots=True, eq=False)
class Map:
    vertices: NDArray[np.float32]
    """(V, 3) metres, world frame."""
    faces: NDArray[np.int32]
    """(F, 3) vertex numbers, counter-clockwise seen from the front."""
    colours: NDArray[np.uint8]
    """(V, 3) sRGB."""


class MapMaker(Protocol):
    """Yours. Used from one thread at a time. For a flight that can be repeated, the map must be a function of the
    keyframes given so far and their order, of nothing else."""

    def add(self, keyframe: Keyframe) -> None:
        """Take in the next one. What it raises is told, and the next one is given."""
        ...

    def mesh(self) -> Map:
        """Of all keyframes so far; may be empty. What it raises is told instead."""
        ...


class MapProcess:
    """What is asked and answered, without the bus."""

    def __init__(self, make: Callable[[], MapMaker]) -> None:
        self._make = make
        self._maker = make()
        self._epoch = 0
        self._next = 0

    @property
    def question(self) -> str:
        """Parameters of the next query."""
        return f"epoch={self._epoch};from={self._next}"

    def take(self, page: KeyframePage) -> ExternalMesh | None:
        """Take in what is new; the map, if it is waited for."""
        if (page.epoch, page.first) != (self._epoch, self._next):
            if self._next:
                log.warning("another list of keyframes: beginning anew")
                self._maker = self._make()
            self._epoch, self._next = page.epoch, page.first
        for content in page.keyframes:
            try:
                self._maker.add(decode(Keyframe, content))
            except Exception:
                log.exception("a keyframe could not be taken in")
        self._next = page.next
        return self._mesh() if page.wanted else None

    def _mesh(self) -> ExternalMesh:
        try:
            made = self._maker.mesh()
            mesh = self._message(made.vertices, made.faces, made.colours)
            encode(mesh)
        except Exception as error:
            log.exception("there is no map")
            fault = f"{type(error).__name__}: {error}"[:FAULT_LETTERS]
            nothing = np.zeros((0, 3))
            return self._message(nothing.astype(np.float32), nothing.astype(np.int32), nothing.astype(np.uint8), fault)
        return mesh

    def _message(
        self, vertices: NDArray[Any], faces: NDArray[Any], colours: NDArray[Any], fault: str = ""
    ) -> ExternalMesh:
        return ExternalMesh(
            epoch=self._epoch, taken=self._next, vertices=vertices, faces=faces, colours=colours, fault=fault
        )


async def serve_map(bus: Bus, make: Callable[[], MapMaker]) -> None:
    """Until cancelled, with or without a ground station."""
    process = MapProcess(make)
    bus.announce(ROLE)
    while True:
        try:
            page = await bus.ask(topics.MAP_KEYFRAMES, process.question, timeout_s=ASK_TIMEOUT_S)
        except NoReply:
            await asyncio.sleep(RETRY_S)
            continue
        mesh = await asyncio.to_thread(process.take, page)
        if mesh is not None:
            bus.put(topics.EXTERNAL_MESH, mesh)


def run_map_process(make: Callable[[Mission], MapMaker]) -> int:
    """``main`` of such a process, with the arguments that all processes of a mission have; its exit code.

    ``make`` gives a new, empty map, also when the list of keyframes begins anew.
    """

    async def body(arguments: Arguments) -> None:
        async with connect(arguments.link, arguments.mission.name, lossless=arguments.lockstep) as bus:
            await serve_map(bus, lambda: make(arguments.mission))

    return run_process(ROLE, body)
