"""Answers whoever watches the map: the blocks that changed since they asked last. Nobody asks, nothing is done."""

from __future__ import annotations

import asyncio

from ground_station.map_feedback import MapFeedback
from ground_station.mesh_blocks import MeshBlocks
from ground_station.reconstruction.reconstructor import Mesh
from protocol.errors import MessageError
from protocol.messages import MeshPage


class MapService:
    def __init__(self, feedback: MapFeedback) -> None:
        self._feedback = feedback
        self._blocks = MeshBlocks()
        self._split: Mesh | None = None
        """The map that the blocks are of."""
        self._one_at_a_time = asyncio.Lock()

    async def answer(self, parameters: dict[str, str]) -> MeshPage:
        """To ``since=120;epoch=7``. Raises `MessageError` if these are no numbers."""
        try:
            since, epoch = int(parameters.get("since", 0)), int(parameters.get("epoch", 0))
        except ValueError as error:
            raise MessageError(f"map: since and epoch must be numbers: {parameters}") from error
        async with self._one_at_a_time:
            newest = self._feedback.mesh
            if newest is not None and newest is not self._split:
                await asyncio.to_thread(self._blocks.update, newest)
                self._split = newest
        return self._blocks.page(since, epoch)
