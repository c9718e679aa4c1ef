"""All that one drone's agent does about obstacles: it hears the map, keeps what planner and ways know of it up to date,
says how long it has been silent, and climbs where the drone is held. Without obstacles every answer is the empty one.
"""

from __future__ import annotations

from collections.abc import Callable

from agents.climbing import Climbing
from agents.obstacles import Obstacles
from agents.planners.planner import Decision, Planner
from protocol import topics
from protocol.bus import Bus
from protocol.geometry import Floats
from protocol.messages import FreeCells
from protocol.mission import Mission


class ObstacleWatch:
    def __init__(self, mission: Mission, planner: Planner, now_s: Callable[[], float], *, lockstep: bool) -> None:
        """``planner`` heeds the obstacles from now on; ``now_s``: as of `agents.agent.Agent`."""
        self._now_s, self._lockstep = now_s, lockstep
        self._heard_s = now_s()
        self.obstacles = Obstacles(mission) if mission.flight.obstacles.enabled else None
        """What is known of them; None in missions without."""
        self._climbing = None
        if self.obstacles is not None:
            planner.heed(self.obstacles)
            self._climbing = Climbing(mission, self.obstacles)

    def listen(self, bus: Bus) -> None:
        if self.obstacles is not None:
            bus.on(topics.FREE, self._hear)

    def _hear(self, cells: FreeCells) -> None:
        self._heard_s = self._now_s()
        if self.obstacles is not None:
            self.obstacles.hear(cells)

    @property
    def silence(self) -> tuple[float, float] | None:
        """When the newest map came, and now; None where none is waited for by the clock."""
        return None if self.obstacles is None or self._lockstep else (self._heard_s, self._now_s())

    def is_ready(self, tick: int) -> bool:
        """Whether the map by which all fly at ``tick`` has come."""
        return self.obstacles is None or self.obstacles.is_ready(tick)

    def advance(self, tick: int, deviation_m: float) -> None:
        """Take the newest map that is in effect at ``tick``. ``deviation_m``: of the own position."""
        if self.obstacles is not None:
            self.obstacles.advance(tick, deviation_m)

    def wish(self, place: Floats, time_s: float) -> Floats | None:
        """Velocity (5,) while the drone at ``place`` (3,) climbs; None while its planner decides."""
        return None if self._climbing is None else self._climbing.wish(place, time_s)

    def look(self, place: Floats, decision: Decision, time_s: float) -> None:
        """Begin to climb if what the planner decided for ``place`` (3,) has been of no use for too long."""
        if self._climbing is not None:
            self._climbing.look(place, decision, time_s)

    def put_off(self) -> None:
        """The drone does something else now than what its planner decides."""
        if self._climbing is not None:
            self._climbing.put_off()
