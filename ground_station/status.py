"""What people see of a running mission: the newest of each drone, and rates, gathered for the status message."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet

from ground_station.results import Metrics
from ground_station.separation import nearest_distances
from protocol.messages import DroneState, DroneStatus, Phase, ReplicaState, Status
from protocol.mission import Mission
from protocol.news import Tell

UNKNOWN = 2**62


class StatusBoard:
    def __init__(self, mission: Mission, tell: Tell) -> None:
        """``tell``: who wants to know of those who come and go."""
        self._mission, self._tell = mission, tell
        self._newest: dict[int, DroneState] = {}
        self._lives: AbstractSet[str] = frozenset()
        self._separation = math.inf
        self._nearest: dict[int, float] = {}
        self._began_s: float | None = None
        self._before: tuple[float, int] | None = None
        self.activity = ""
        """What the ground station is doing, when it is not simply flying."""

    def hear(self, state: DroneState) -> None:
        known = self._newest.get(state.drone)
        if known is None or known.tick <= state.tick:
            self._newest[state.drone] = state

    @property
    def all_landed(self) -> bool:
        """Whether no drone of the mission will fly any more."""
        states = [self._newest.get(drone.id) for drone in self._mission.drones]
        return all(state is not None and state.mode == "landed" for state in states)

    def all_lack_phi(self, drones: Iterable[int]) -> bool:
        """Whether each of ``drones``, at least one, says that its phi is not complete."""
        states = [self._newest.get(drone) for drone in drones]
        return bool(states) and all(state is not None and state.replica.missing > 0 for state in states)

    def lost_states(self, drone: int) -> int:
        """How many states the phi of ``drone`` lacks, for whoever has to choose one; very many if it never spoke."""
        state = self._newest.get(drone)
        return state.replica.lost if state is not None else UNKNOWN

    def note_lives(self, alive: AbstractSet[str]) -> None:
        """Say who came and who went."""
        if alive == self._lives:
            return
        for role in sorted(self._lives - alive):
            self._tell("warning", "link", f"{role} is gone")
        for role in sorted(alive - self._lives):
            self._tell("info", "link", f"{role} is there")
        self._lives = frozenset(alive)

    def note_poses(self, poses: Mapping[int, Sequence[float]]) -> None:
        self._nearest = nearest_distances(poses)
        self._separation = min(self._separation, *self._nearest.values(), math.inf)

    def states(self, drones: Iterable[int]) -> dict[int, DroneState]:
        """The newest of each of ``drones`` that was heard."""
        return {drone: self._newest[drone] for drone in drones if drone in self._newest}

    def wall_s(self, now_s: float) -> float:
        """Wall time since the first status after take-off."""
        return 0.0 if self._began_s is None else now_s - self._began_s

    def status(
        self,
        metrics: Metrics,
        replica: ReplicaState,
        *,
        phase: Phase,
        backlog: int,
        dropped: int,
        refused: int,
        unwritten: int,
        loop_lag_s: float,
        alive: AbstractSet[str],
        now_s: float,
    ) -> Status:
        """``now_s``: monotonic wall time, for rates."""
        if self._began_s is None and phase not in ("waiting", "starting"):
            self._began_s = now_s
        rate = 0.0
        if self._before is not None and now_s > self._before[0]:
            rate = (metrics.keyframes - self._before[1]) / (now_s - self._before[0])
        self._before = (now_s, metrics.keyframes)
        scores = metrics.scores
        return Status(
            phase=phase,
            activity=self.activity or self._describe(phase, metrics, backlog, alive),
            tick=metrics.tick,
            time_s=metrics.time_s,
            importance=metrics.importance,
            f_score_visible=scores.visible.f if scores else 0.0,
            f_score_objects=scores.objects.f if scores else 0.0,
            keyframes=metrics.keyframes,
            dropped=dropped,
            replica=replica,
            refused=refused,
            unwritten=unwritten,
            loop_lag_s=loop_lag_s,
            keyframes_per_s=rate,
            jumps=metrics.jumps,
            min_separation_m=self._separation if math.isfinite(self._separation) else 0.0,
            drones=tuple(self._row(drone.id, alive) for drone in self._mission.drones),
        )

    def _describe(self, phase: Phase, metrics: Metrics, backlog: int, alive: AbstractSet[str]) -> str:
        if phase == "waiting":
            return "waiting for an operator's start"
        if phase == "starting":
            expected = ["sim", *(f"drone/{drone.id}" for drone in self._mission.drones)]
            missing = [role for role in expected if role not in alive]
            return f"waiting for {', '.join(missing)}" if missing else "starting"
        feedback = self._mission.feedback
        active = feedback.method != "none" and metrics.importance < feedback.threshold
        return f"flying, map feedback {'on' if active else 'off'}" + (
            f", {backlog} images wait" if backlog > 50 else ""
        )

    def _row(self, drone: int, alive: AbstractSet[str]) -> DroneStatus:
        state = self._newest.get(drone)
        nearest = self._nearest.get(drone, math.inf)
        control = state.control if state else None
        return DroneStatus(
            drone=drone,
            alive=f"drone/{drone}" in alive,
            mode=state.mode if state else "waiting",
            position=state.pose[:3] if state else (0.0, 0.0, 0.0),
            speed_mps=math.hypot(*state.velocity[:3]) if state else 0.0,
            separation_m=nearest if math.isfinite(nearest) else 0.0,
            slack=control.slack if control else 0.0,
            solve_s=control.solve_s if control else 0.0,
            fallbacks=control.fallbacks if control else 0,
        )
