"""Who has to be there before the first tick."""

from __future__ import annotations

import logging

from protocol.bus import Bus
from protocol.errors import ProcessError
from protocol.mission import Mission

log = logging.getLogger(__name__)


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
        raise ProcessError(f"not started within {patience_s:g} s: {missing}")
    log.error("not started within %g s: %s: going on without", patience_s, missing)
