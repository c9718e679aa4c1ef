"""What can be seen on the bus of a flight from a place that no fault touches: beside the router."""

from __future__ import annotations

import asyncio
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol import topics
from protocol.blocks import BlockLayout
from protocol.bus import Bus
from protocol.errors import NoReply
from protocol.field import VirtualField
from protocol.messages import DroneState, Jump, JumpHead, MissionPhase, PhiPage, ReplicaState, Status, Tick
from protocol.mission import Mission
from protocol.wire import encode

GROUND = 0
"""Stands for the ground station where replicas are numbered by drone."""
AHEAD_TICKS = 24
"""How far in the future replicas are asked for: further than questions take to arrive."""
ANSWER_S = 4.0
"""For a replica to get there, and for its page to travel."""
FRESH_TICKS = 30
"""A state older than this is no sign of life."""


@dataclass(frozen=True)
class Comparison:
    """All replicas at one tick."""

    tick: int
    bit_equal: bool
    worst_rms: float
    """Largest root mean square difference between a drone's and the ground station's block."""


@dataclass(frozen=True)
class Replica:
    tick: int
    epoch: int
    next_sequence: int
    phi: NDArray[np.float32]
    """(positions, directions)."""


class Monitor:
    def __init__(self, mission: Mission, bus: Bus) -> None:
        self._bus = bus
        self._drones = [drone.id for drone in mission.drones]
        field = VirtualField.of(mission.target)
        self._layout = BlockLayout(field.shape)
        self.tick = -1
        self.head = JumpHead(epoch=0, next_sequence=0, done=0, phase="starting")
        self.status: Status | None = None
        self.phase: MissionPhase | None = None
        self.states: dict[int, DroneState] = {}
        self.jumps: dict[tuple[int, int], bytes] = {}
        """All that were published, encoded, by epoch and sequence."""
        self.contradictions: list[str] = []
        """What must never be seen: two jumps under one number, a replica that forgets one."""
        bus.on(topics.TICK, self._hear_tick)
        bus.on(topics.HEAD, self._hear_head)
        bus.on(topics.STATUS, self._hear_status)
        bus.on(topics.PHASE, self._hear_phase)
        bus.on(topics.STATE, self._hear_state)
        bus.on(topics.JUMP, self._hear_jump)
        bus.watch_lives()

    def _hear_tick(self, tick: Tick) -> None:
        self.tick = max(self.tick, tick.tick)

    def _hear_head(self, head: JumpHead) -> None:
        self.head = head

    def _hear_status(self, status: Status) -> None:
        self.status = status

    def _hear_phase(self, phase: MissionPhase) -> None:
        self.phase = phase

    def _hear_state(self, state: DroneState) -> None:
        if state.drone not in self._drones or state.tick > self.tick + FRESH_TICKS:
            return  # a fault's own invention
        self.states[state.drone] = state

    def _hear_jump(self, jump: Jump) -> None:
        key, encoded = (jump.epoch, jump.sequence), encode(jump)
        if self.jumps.setdefault(key, encoded) != encoded:
            self.contradictions.append(f"two different jumps {jump.sequence} of epoch {jump.epoch}")

    # --- judging -------------------------------------------------------------------------------------------------

    @property
    def alive(self) -> set[str]:
        return self._bus.alive

    @property
    def importance(self) -> float:
        """J of the ground station; 1 before it said so."""
        return self.status.importance if self.status is not None and self.status.phase != "starting" else 1.0

    def refused(self) -> int:
        """Messages so far that were none of their topic."""
        return sum(self._bus.statistics.refused.values())

    def replicas(self) -> dict[int, ReplicaState]:
        """Of those that were heard lately."""
        return {drone: state.replica for drone, state in self.states.items() if state.tick > self.tick - FRESH_TICKS}

    def is_healed(self, lost: Collection[int] = ()) -> bool:
        """Everybody but the drones that are ``lost`` is there, knows all of phi and all jumps, and integrates with
        little delay."""
        left = [drone for drone in self._drones if drone not in lost]
        replicas = {drone: replica for drone, replica in self.replicas().items() if drone not in lost}
        return (
            {"ground", "sim", *(f"drone/{drone}" for drone in left)} <= self.alive
            and len(replicas) == len(left)
            and self.head.done > self.tick - FRESH_TICKS
            and all(
                replica.missing == 0
                and replica.epoch == self.head.epoch
                and replica.next_jump >= self.head.next_sequence
                and replica.tick > self.tick - FRESH_TICKS
                for replica in replicas.values()
            )
        )

    async def compare(self, lost: Collection[int] = ()) -> Comparison | None:
        """All replicas, but those of drones that are ``lost``, at one tick of the near future; None when one of them
        did not answer for it."""
        tick = self.tick + AHEAD_TICKS
        asked = [GROUND, *(drone for drone in self._drones if drone not in lost)]
        found = await asyncio.gather(*(self._replica(drone, tick) for drone in asked))
        ground, *others = found
        if ground is None:
            return None
        worst = 0.0
        equal = True
        for other in others:
            same = other is not None and (other.tick, other.epoch, other.next_sequence) == (
                ground.tick,
                ground.epoch,
                ground.next_sequence,
            )
            if other is None or not same:
                return None
            equal &= other.phi.tobytes() == ground.phi.tobytes()
            apart = np.square(other.phi.astype(np.float64) - ground.phi)
            worst = max(worst, *(float(np.sqrt(apart[self._layout.rows(b)].mean())) for b in range(self._layout.count)))
        return Comparison(ground.tick, equal, worst)

    async def _replica(self, drone: int, tick: int) -> Replica | None:
        topic = topics.DRONE_BLOCKS if drone else topics.BLOCKS
        each = self._layout.blocks_a_page()
        asked = [range(first, min(first + each, self._layout.count)) for first in range(0, self._layout.count, each)]
        try:
            pages: list[PhiPage] = await asyncio.gather(
                *(
                    self._bus.ask(topic, f"blocks={'+'.join(map(str, blocks))};from={tick}", drone or "", ANSWER_S)
                    for blocks in asked
                )
            )
        except NoReply:
            return None
        if any(
            page.tick != tick or page.blocks.tolist() != list(blocks) for page, blocks in zip(pages, asked, strict=True)
        ):
            return None
        phi = np.concatenate([page.phi for page in pages])
        return Replica(tick, pages[0].epoch, pages[0].next_sequence, phi)
