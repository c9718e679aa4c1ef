"""What keeps the ground station's death cheap: checkpoints while it flies, and the way back in.

On its way back it has the journal, and map and record of its last checkpoint. Its phi it takes from a drone, which
went on integrating meanwhile; without one, from the checkpoint: then cells seen since have to be seen again.
"""

from __future__ import annotations

import asyncio
import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ground_station.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from ground_station.durable import DiskFaults
from ground_station.jump_publisher import JumpPublisher
from ground_station.map_feedback import MapFeedback
from ground_station.mapper import Mapper
from ground_station.results import RunFolder
from protocol.bus import Bus
from protocol.errors import ProcessError, ReconstructionError, StorageError
from protocol.messages import Tick
from protocol.mission import Mission
from protocol.replication import Replication

log = logging.getLogger(__name__)

DRONE_PATIENCE_TICKS = 200
"""Ticks without phi from any drone, though the router is there, after which it comes from the checkpoint."""


class Recovery:
    def __init__(
        self,
        mission: Mission,
        bus: Bus,
        run: RunFolder,
        replication: Replication,
        jumps: JumpPublisher,
        feedback: MapFeedback,
        mapper: Mapper,
    ) -> None:
        self._mission, self._bus, self._run, self._mapper = mission, bus, run, mapper
        self._replication, self._jumps, self._feedback = replication, jumps, feedback
        self._faults = DiskFaults(f"{run.path}: checkpoint")
        self._period = max(1, round(mission.replication.checkpoint_period_s / mission.tick_s))
        self._next = self._period
        self._saving: asyncio.Task[None] | None = None
        self._compactable = 0
        self._checkpoint: Checkpoint | None = None
        self._resuming = False
        self._waited = 0

    @property
    def unwritten(self) -> int:
        """Checkpoints that the disk refused."""
        return self._faults.count

    # --- the way back --------------------------------------------------------------------------------------------

    async def load(self) -> None:
        """Read what an earlier life of this process left.

        Raises:
            MissionError: the checkpoint is of another mission.
            StorageError: the disk refuses to read it.
        """
        folder: Path = self._run.path
        self._checkpoint = await asyncio.to_thread(load_checkpoint, folder, self._mission)
        self._resuming = self._checkpoint is not None or self._jumps.next_sequence > 0
        if self._checkpoint is not None:
            self._jumps.earlier = int(self._checkpoint.totals["earlier_jumps"])
            if self._checkpoint.epoch != self._jumps.epoch:
                self._jumps.earlier += self._checkpoint.next_sequence
            elif self._checkpoint.next_sequence > self._jumps.next_sequence:
                await self._jumps.renew("the journal lacks jumps that the checkpoint has")
        self._jumps.recall()

    def begin(self, tick: Tick) -> None:
        """At the first tick heard; later than the mission's first, it is a way back.

        Raises:
            ProcessError: the mission starts anew, in a folder that holds another flight of it.
        """
        if tick.tick == 0:
            if self._resuming:
                raise ProcessError(f"{self._run.path}: holds a flight already, and the simulator starts a new one")
            return
        checkpoint = self._checkpoint
        log.warning(
            "back at tick %d, with %s and %d jumps",
            tick.tick,
            f"the checkpoint of tick {checkpoint.tick}" if checkpoint else "no checkpoint",
            self._jumps.next_sequence,
        )
        self._next = tick.tick + self._period
        self._feedback.resume(lambda: self._restore_map(checkpoint), sent=tick.keyframes)

    def _restore_map(self, checkpoint: Checkpoint | None) -> None:
        """On the map's thread."""
        try:
            again = self._mapper.restore(checkpoint.map if checkpoint else None)
        except ReconstructionError as error:
            log.error("the map of the checkpoint cannot be used: %s", error)  # noqa: TRY400  # the file's fault
            again = self._mapper.restore(None)
        log.info("the map is back; %d keyframes were mapped again", again)

    def proceed(self, *, hopeless: bool) -> None:
        """Once a tick while phi is not complete: take the checkpoint's when no drone has it.

        ``hopeless``: all drones that are live say that they lack it themselves.
        """
        self._waited += "sim" in self._bus.alive
        if self._waited < DRONE_PATIENCE_TICKS and not hopeless:
            return
        checkpoint = self._checkpoint
        phi = self._replication.replica.field.phi
        if checkpoint is not None:
            log.warning("no drone has phi: going on with that of tick %d", checkpoint.tick)
            same = checkpoint.epoch == self._jumps.epoch
            self._replication.restore(checkpoint.phi, checkpoint.next_sequence if same else 0)
        else:
            log.error("neither a drone nor a checkpoint has phi: it starts anew")
            self._replication.restore(np.ones_like(phi), 0)

    # --- checkpoints ---------------------------------------------------------------------------------------------

    def save_if_due(self) -> None:
        """Begin a checkpoint if it is time, and the last one is done."""
        replica = self._replication.replica
        busy = self._saving is not None and not self._saving.done()
        if replica.tick < self._next or busy or not self._replication.known:
            return
        self._checkpoint = None  # it has served
        self._next = replica.tick + self._period
        phi, tick, taken = replica.field.phi.copy(), replica.tick, replica.jumps.taken
        self._saving = asyncio.create_task(self._save(phi, tick, taken, self._jumps.epoch))

    async def _save(self, phi: NDArray[np.float32], tick: int, taken: int, epoch: int) -> None:
        totals = {"earlier_jumps": self._jumps.earlier}

        def save() -> None:
            checkpoint = Checkpoint(epoch, tick, taken, phi, self._mapper.state(), totals)
            save_checkpoint(self._run.path, self._mission, checkpoint)

        await asyncio.to_thread(self._run.checkpoint)
        try:
            await self._feedback.on_worker(save)
        except StorageError as error:
            self._faults.refused(error)
            return
        self._faults.took()
        if epoch == self._jumps.epoch:
            await self._jumps.compact(self._compactable, self._mission.replication.journal_limit_mb * 1e6)
        self._compactable = taken

    async def close(self) -> None:
        """Wait for the checkpoint that is being written."""
        if self._saving is not None:
            await self._saving
