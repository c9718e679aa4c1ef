"""Where motion capture would see the vehicles, told to the mission as a real system's poses are."""

from __future__ import annotations

import asyncio
import threading

import numpy as np

from protocol import topics
from protocol.bus import Bus, connect
from protocol.messages import Tick
from protocol.mission import Mission
from protocol.session import Link
from sim_bridge.motion_capture import SimulatedCapture
from sim_bridge.px4_endpoint.endpoint import Endpoint


async def show(mission: Mission, link: Link | str, endpoint: Endpoint, ended: threading.Event) -> None:
    """Until ``ended``.

    Raises:
        BusError: there is no router.
    """
    async with connect(link, mission.name) as bus:
        await Eyes(mission, bus, endpoint).watch(ended)


class Eyes:
    def __init__(self, mission: Mission, bus: Bus, endpoint: Endpoint) -> None:
        self._bus, self._endpoint = bus, endpoint
        self._capture = SimulatedCapture(mission, in_step=False)
        self._period_s = 1 / mission.mocap.rate_hz
        self._tick = 0
        bus.on(topics.TICK, self._hear_tick)

    def _hear_tick(self, tick: Tick) -> None:
        self._tick = tick.tick

    async def watch(self, ended: threading.Event) -> None:
        loop = asyncio.get_running_loop()
        began, step = loop.time(), 0
        while not ended.is_set():
            poses = {drone: np.array(vehicle.pose) for drone, vehicle in self._endpoint.vehicles.items()}
            for seen in self._capture.look(step, poses):
                self._bus.put(topics.MOCAP, seen.model_copy(update={"tick": self._tick}), seen.drone)
            step = max(step + 1, int((loop.time() - began) / self._period_s))
            await asyncio.sleep(max(0.0, began + step * self._period_s - loop.time()))
