"""What has to be before the first tick: everybody there, and where a mission says so, an operator's start."""

from __future__ import annotations

import logging

from protocol import topics
from protocol.bus import Bus
from protocol.errors import ProcessError
from protocol.messages import JumpHead, MissionPhase, Phase
from protocol.mission import Mission

log = logging.getLogger(__name__)

LOOK_S = 60.0
"""An operator may take as long as he likes; so often it is looked again."""


async def wait_for_everybody(bus: Bus, mission: Mission) -> None:
    """For as long as the mission allows; a drone that comes later joins in flight.

    Raises:
        ProcessError: the ground station or all drones are missing.
    """
    patience_s = mission.simulation.start_patience_s
    drones = {f"drone/{drone.id}" for drone in mission.drones}
    wanted = {"ground", *drones}
    if await bus.until(lambda: wanted <= bus.alive, patience_s):
        return
    missing = ", ".join(sorted(wanted - bus.alive))
    if "ground" not in bus.alive or not drones & bus.alive:
        raise ProcessError(f"not started within {patience_s:g} s: {missing}; their logs say why")
    log.error("not started within %g s: %s: going on without", patience_s, missing)


class MissionWatch:
    """What the ground station says of the mission. Make it before the ground station can have spoken."""

    def __init__(self, bus: Bus, mission: Mission) -> None:
        self._bus, self._on_command = bus, mission.start == "on_command"
        self._phase: Phase = "waiting"
        self.head = JumpHead(epoch=0, next_sequence=0, done=0, phase="starting")
        """The newest."""
        bus.on(topics.PHASE, self._hear_phase)
        bus.on(topics.HEAD, self._hear_head)

    def _hear_phase(self, phase: MissionPhase) -> None:
        self._phase = phase.phase

    def _hear_head(self, head: JumpHead) -> None:
        self.head = head

    @property
    def is_over(self) -> bool:
        """Whether the mission is finished; of the two messages that say so, either may come first."""
        return "finished" in (self._phase, self.head.phase)

    async def wait_for_start(self) -> None:
        """Until an operator has started the mission, or ended it; at once where none is waited for."""
        if self._on_command:
            log.info("waiting for an operator's start")
            while not await self._bus.until(lambda: self._phase != "waiting", LOOK_S):
                pass
