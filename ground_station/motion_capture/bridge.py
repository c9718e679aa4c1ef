"""Passes the poses of a motion capture system on to the drones, for as long as any of them flies.

It takes no part in the mission: who is not seen by it holds and lands by its own policies.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from typing import Final

from ground_station.motion_capture.bodies import Bodies
from ground_station.motion_capture.eye import Eye, Failure, Frame, require_library
from protocol import topics
from protocol.bus import Bus, connect
from protocol.messages import MissionPhase, Tick
from protocol.mission import Mission
from protocol.session import Link

log = logging.getLogger(__name__)

ROLE: Final = "mocap"
CONNECT_S: Final = 20.0
"""How long the library may take to start, to connect and to give its first frame."""
SILENT_S: Final = 5.0
"""A system that gives no frame for so long is connected to anew, ..."""
RETRY_S: Final = 2.0
"""... after so long."""
REPORT_S: Final = 30.0
"""Between two lines that say how many poses were passed on."""


class Bridge:
    def __init__(
        self,
        mission: Mission,
        bus: Bus,
        *,
        now_s: Callable[[], float] = time.monotonic,
        open_eye: Callable[[Mission], Eye] = Eye,
    ) -> None:
        self._mission, self._bus, self._now_s, self._open_eye = mission, bus, now_s, open_eye
        self._bodies = Bodies(mission, log.info, now_s())
        self._tick = 0
        self._finished = False
        self._patient_until_s = now_s()
        """When the next frame must have come."""
        self._fault = ""
        self._reported_s = now_s()
        bus.on(topics.TICK, self._hear_tick)
        bus.on(topics.PHASE, self._hear_phase)
        bus.watch_lives()

    def _hear_tick(self, tick: Tick) -> None:
        self._tick = tick.tick

    def _hear_phase(self, phase: MissionPhase) -> None:
        self._finished = phase.phase == "finished"

    @property
    def is_over(self) -> bool:
        """The mission, and every drone's flight."""
        return self._finished and not any(role.startswith("drone/") for role in self._bus.alive)

    async def run(self) -> None:
        """Until the mission is over."""
        self._bus.announce(ROLE)
        settings = self._mission.mocap
        while not self.is_over:
            log.info("connecting to %s at %s", settings.system, settings.host)
            eye = self._open_eye(self._mission)
            try:
                await self._pass_on(eye)
            finally:
                await asyncio.to_thread(eye.close)
            if not self.is_over:
                log.warning("%s: %s; trying again", settings.system, self._fault)
                await self._bus.until(lambda: self.is_over, RETRY_S)

    async def _pass_on(self, eye: Eye) -> None:
        """Until there is no more of it, or it is silent for too long."""
        loop = asyncio.get_running_loop()
        self._patient_until_s, self._fault = self._now_s() + CONNECT_S, ""
        loop.add_reader(eye.connection.fileno(), self._read, eye)
        try:
            while not self._fault and not self.is_over:
                await self._bus.until(lambda: bool(self._fault) or self.is_over, 1.0)
                now_s = self._now_s()
                if now_s > self._patient_until_s:
                    self._fault = "no frame comes"
                if now_s - self._reported_s > REPORT_S:
                    self._reported_s = now_s
                    log.info("%s", self._bodies.report(now_s))
        finally:
            loop.remove_reader(eye.connection.fileno())

    def _read(self, eye: Eye) -> None:
        """One frame, or why there are none."""
        try:
            found = eye.connection.recv()
        except (EOFError, OSError):
            found = Failure("its process ended")
        if isinstance(found, Frame):
            now_s = self._now_s()
            self._patient_until_s = now_s + SILENT_S
            age_s = max(0.0, now_s - found.at_s) + self._mission.mocap.latency_s
            for pose in self._bodies.frame(found.seen, found.at_s, self._tick, age_s):
                self._bus.put(topics.MOCAP, pose, pose.drone)
            return
        self._fault = found.reason
        self._bus.recheck()


async def run_bridge(mission: Mission, link: Link) -> None:
    """Raises: ProcessError: the library is not installed."""
    require_library()
    async with connect(link, mission.name) as bus:
        await Bridge(mission, bus).run()
    log.info("the mission is over")
