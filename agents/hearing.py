"""Where a drone hears of its team: from every other by itself, or of a large one in the router's gathered messages.

A router that does not gather, an external or an older one, must not make its drones deaf: then they hear each other
directly, until it gathers again.
"""

from __future__ import annotations

from agents.team import Team
from protocol import topics
from protocol.aggregator import is_gathered
from protocol.bus import Bus
from protocol.errors import MessageError
from protocol.messages import DroneState, TeamStates
from protocol.mission import Mission
from protocol.news import Tell
from protocol.replication import Replication
from protocol.team_states import Sighting, unpack

MISSED_S = 0.5
"""How long gathered states may stay away ..."""
STEADY_S = 2.0
"""... and must then have come again, before the others need not be heard by themselves any more."""


class Hearing:
    def __init__(
        self,
        mission: Mission,
        drone: int,
        bus: Bus,
        replication: Replication,
        team: Team,
        tell: Tell,
        *,
        lockstep: bool,
    ) -> None:
        """What is heard goes to ``replication`` and ``team``."""
        self._drone, self._bus, self._replication, self._team, self._tell = drone, bus, replication, team, tell
        self._missed_ticks, self._steady_ticks = (round(limit / mission.tick_s) for limit in (MISSED_S, STEADY_S))
        self._gathered = is_gathered(mission, lockstep=lockstep)
        self._directly = not self._gathered
        self._lockstep = lockstep
        self._unheard = self._steady = 0
        self.tick = 0
        """This drone's own newest."""
        if self._gathered:
            bus.on(topics.TEAM, self._hear_team, wakes=False)
        else:
            bus.on(topics.STATE, self._hear, wakes=lockstep)

    def _hear(self, state: DroneState | Sighting) -> None:
        if state.drone != self._drone:
            self._replication.hear_state(state)
            self._team.hear(state, self.tick)  # also one whose state phi cannot use is an obstacle

    def _hear_team(self, message: TeamStates) -> None:
        try:
            sightings = unpack(message)
        except MessageError:
            self._bus.statistics.refused[topics.TEAM.key] += 1
            return
        self._unheard = 0
        for sighting in sightings:
            self._hear(sighting)

    def look(self) -> None:
        """Once in each tick that something is decided in: take what has arrived, and see whether the router gathers."""
        if not self._lockstep:
            self._bus.poll()  # states wake nobody, and beats may stay away
        if not self._gathered:
            return
        if self._bus.alive:  # nobody is, while the router is away: then there is nothing to hear
            self._unheard += 1
        self._steady = self._steady + 1 if self._unheard < self._missed_ticks else 0
        if not self._directly and self._unheard > self._missed_ticks:
            self._tell("warning", "link", "the router gathers no states: hearing every drone by itself")
            self._bus.on(topics.STATE, self._hear, wakes=False)
            self._directly = True
        elif self._directly and self._steady >= self._steady_ticks:
            self._tell("info", "link", "the router gathers states again")
            self._bus.off(topics.STATE, wakes=False)
            self._directly = False
