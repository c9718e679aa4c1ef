"""What the console knows of the mission: the newest that it heard of everything, and its course over time."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field

from ground_station.console.drone_view import Trail
from ground_station.console.events import EventList
from ground_station.console.fleet import FleetRow, fleet_row
from ground_station.console.history import History
from protocol.messages import DroneState, Event, FreeCells, Keyframe, MissionPhase, Status
from protocol.mission import Mission

CURVES = ("importance", "f_score_visible", "f_score_objects")
"""Fields of the status whose course is shown."""


@dataclass(slots=True)
class Drone:
    """One drone as far as it was heard."""

    state: DroneState | None = None
    heard_s: float = 0.0
    """When ``state`` came."""
    keyframe: Keyframe | None = None
    trail: Trail = field(default_factory=Trail)


class Situation:
    def __init__(self, mission: Mission, now_s: Callable[[], float]) -> None:
        """``now_s``: monotonic seconds, to judge silence by."""
        self._mission, self._now_s = mission, now_s
        self.drones = {drone.id: Drone() for drone in mission.drones}
        self.status: Status | None = None
        self.phase: MissionPhase | None = None
        self.free: FreeCells | None = None
        self.events = EventList()
        self.history = History(len(CURVES))
        self._ground_heard_s: float | None = None

    def hear_state(self, state: DroneState) -> None:
        drone = self.drones.get(state.drone)
        if drone is None or (drone.state is not None and state.tick < drone.state.tick):
            return
        drone.state, drone.heard_s = state, self._now_s()
        drone.trail.add(state.pose[:3])

    def hear_keyframe(self, keyframe: Keyframe) -> None:
        drone = self.drones.get(keyframe.drone)
        if drone is not None:
            drone.keyframe = keyframe

    def hear_status(self, status: Status) -> None:
        self.status = status
        self._ground_heard_s = self._now_s()
        if status.phase in ("flying", "finished"):
            self.history.add(status.time_s, [getattr(status, name) for name in CURVES])

    def hear_phase(self, phase: MissionPhase) -> None:
        self.phase = phase
        self._ground_heard_s = self._now_s()

    def hear_free(self, cells: FreeCells) -> None:
        self.free = cells

    def hear_event(self, event: Event) -> None:
        self.events.add(event)

    @property
    def ground_age_s(self) -> float | None:
        """Since the ground station was heard; None before it ever was."""
        return None if self._ground_heard_s is None else self._now_s() - self._ground_heard_s

    def states(self) -> dict[int, DroneState]:
        """The newest of each drone that was heard, ascending by id."""
        return {number: drone.state for number, drone in sorted(self.drones.items()) if drone.state is not None}

    def fleet(self, alive: Collection[str]) -> list[FleetRow]:
        """``alive``: roles with a liveliness token."""
        now_s = self._now_s()
        finished = self.phase is not None and self.phase.phase == "finished"
        return [
            fleet_row(
                number,
                drone.state,
                None if drone.state is None else now_s - drone.heard_s,
                f"drone/{number}" in alive,
                self._mission.vehicles,
                finished=finished,
            )
            for number, drone in sorted(self.drones.items())
        ]
