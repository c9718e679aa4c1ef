"""The world of vehicles that fly by themselves: beats the mission's time, and renders what their cameras would see.

PX4 flies, in hardware, in SITL or as our endpoint, and its telemetry reaches everybody in the drones' states. This
process may die and be started again: agents and ground station go on by their own clocks, and it joins them.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from protocol import topics
from protocol.bus import Bus
from protocol.messages import DroneState, Mode, Tick
from protocol.mission import Mission
from sim_bridge.darkroom import Darkroom
from sim_bridge.roll_call import MissionWatch, wait_for_everybody

if TYPE_CHECKING:
    from sim_bridge.photographer import Photographer

log = logging.getLogger(__name__)

JOIN_S = 1.0
"""How long states are listened for before a mission is begun: one that is under way is joined instead."""
ASIDE: Sequence[Mode] = ("starting", "landed", "yielded")
"""Drones that take no part in the coverage: the cells around them are the others'."""


class Observer:
    def __init__(self, mission: Mission, bus: Bus, photographer: Photographer | None) -> None:
        self._mission, self._bus = mission, bus
        self._darkroom = Darkroom(bus, photographer)
        self._states: dict[int, DroneState] = {}
        self._watch = MissionWatch(bus, mission)
        self._rendered = {drone.id for drone in mission.drones if not drone.camera}
        self._tick = 0
        bus.on(topics.STATE, self._hear_state)
        bus.watch_lives()

    def _hear_state(self, state: DroneState) -> None:
        known = self._states.get(state.drone)
        if known is None or known.tick <= state.tick:
            self._states[state.drone] = state

    async def run(self) -> None:
        """Until the mission is over and no drone is in the air any more.

        Raises:
            ProcessError: nobody appeared.
        """
        self._bus.announce("sim")
        await self._bus.until(lambda: bool(self._states), JOIN_S)
        if self._states:
            self._tick = 1 + max(state.tick for state in self._states.values())
            log.info("joining at tick %d", self._tick)
        else:
            await wait_for_everybody(self._bus, self._mission)
            await self._watch.wait_for_start()
        loop = asyncio.get_running_loop()
        began, first = loop.time(), self._tick
        try:
            while not self._is_over():
                self._bus.put(topics.TICK, self._beat())
                await self._photograph()
                self._tick += 1
                await asyncio.sleep(max(0.0, began + (self._tick - first) * self._mission.tick_s - loop.time()))
        finally:
            self._darkroom.close()

    def _is_over(self) -> bool:
        gone = not any(role.startswith("drone/") for role in self._bus.alive)
        down = all(state.mode == "landed" for state in self._states.values() if self._is_fresh(state))
        return self._watch.is_over and (gone or down)

    def _is_fresh(self, state: DroneState) -> bool:
        return (self._tick - state.tick) * self._mission.tick_s <= topics.STATE.max_age_s

    def _is_live(self, drone: int) -> bool:
        state = self._states.get(drone)
        return state is not None and state.mode not in ASIDE and self._is_fresh(state)

    def _beat(self) -> Tick:
        return Tick(
            tick=self._tick,
            time_s=self._tick * self._mission.tick_s,
            lockstep=False,
            live=tuple(sorted(drone.id for drone in self._mission.drones if self._is_live(drone.id))),
            vehicles=(),
            jump_epoch=self._watch.head.epoch,
            next_jump=self._watch.head.next_sequence,
            keyframes=self._darkroom.sent,
        )

    async def _photograph(self) -> None:
        """With the cameras that are rendered, of drones in the air."""
        flown = [state for drone, state in self._states.items() if drone in self._rendered and self._is_live(drone)]
        poses = {state.drone: np.array(state.pose) for state in flown}
        velocities = {state.drone: np.array(state.velocity) for state in flown}
        await self._darkroom.photograph(self._tick, poses, velocities, wait=False)
