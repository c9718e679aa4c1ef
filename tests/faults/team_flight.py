"""Whole teams in one process: the agents' pure parts and the simulated vehicles, without transport or images."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from agents.barriers import Neighbour, predicted_pose
from agents.homing import Homecoming
from agents.planners.choice import make_planner
from protocol.field import VirtualField
from protocol.importance import ImportanceField
from protocol.mission import Mission
from sim_bridge.dynamics import VehicleBody


@dataclass
class TeamFlight:
    """Advances a team tick by tick with perfect communication, each drone on its own replica of phi."""

    mission: Mission
    silent: frozenset[int] = frozenset()
    """Rows of drones whose agent is dead: they brake, and the others last heard them at the start."""
    replicas: list[ImportanceField] = field(init=False)
    min_separation: float = field(default=math.inf, init=False)
    path_m: float = field(default=0.0, init=False)
    """Of all drones together."""
    outcomes: list[str] = field(default_factory=list, init=False)

    def __post_init__(self) -> None:
        count = len(self.mission.drones)
        self.bodies = [VehicleBody.at(np.array(drone.start)) for drone in self.mission.drones]
        self.planners = [make_planner(self.mission, drone.id) for drone in self.mission.drones]
        self.replicas = [
            ImportanceField(VirtualField.of(self.mission.target), self.mission.sensing) for _ in range(count)
        ]
        self.tick = 0
        self.cells = np.zeros(count)

    @property
    def importance(self) -> float:
        return self.replicas[-1].importance

    def step(self) -> None:
        dt, flight = self.mission.tick_s, self.mission.flight
        poses = np.array([body.pose for body in self.bodies])
        self._note_separation(poses)
        if self.tick % 20 == 0:
            self.cells = self.replicas[0].owned_cells(poses)
        ids = [drone.id for drone in self.mission.drones]
        predicted = [predicted_pose(body.pose, body.velocity, flight) for body in self.bodies]
        for row, body in enumerate(self.bodies):
            terms = self.replicas[row].advance(poses, dt, row)
            self.planners[row].note_team(ids, poses)
            if row in self.silent:
                continue
            neighbours = [
                Neighbour(ids[other], predicted[other][:3], self.tick * dt if other in self.silent else 0.0)
                for other in range(len(self.bodies))
                if other != row
            ]
            decision = self.planners[row].decide(body.pose, body.velocity, neighbours, terms, self.cells[row])
            self.outcomes.append(decision.outcome)
            body.command(decision.velocity, self.tick * dt, flight)
        for body in self.bodies:
            before = body.pose[:3].copy()
            body.step(dt, self.tick * dt, flight)
            self.path_m += math.dist(before, body.pose[:3])
            assert flight.contains(tuple(body.pose[:3])), f"left the region at {body.pose[:3]}"
            low, high = flight.pitch_limits_rad
            assert low - 1e-6 <= body.pose[4] <= high + 1e-6
        self.tick += 1

    def time_to(self, importance: float, limit_s: float) -> float:
        """Mission time at which J falls below ``importance``."""
        while self.importance >= importance:
            assert self.tick * self.mission.tick_s < limit_s, f"J is still {self.importance:.3f}"
            self.step()
        return self.tick * self.mission.tick_s

    def _note_separation(self, poses: np.ndarray) -> None:
        for one, other in itertools.combinations(poses[:, :3], 2):
            self.min_separation = min(self.min_separation, math.dist(one, other))

    def bring_home(self, homecomings: Sequence[Homecoming], ticks: int) -> Iterator[int]:
        """Everybody returns and lands, the vehicles' own landing left out; yields each tick's number until all would.

        Raises:
            AssertionError: somebody is still on the way after ``ticks``.
        """
        dt, flight = self.mission.tick_s, self.mission.flight
        for tick in range(ticks):
            predicted = [predicted_pose(body.pose, body.velocity, flight) for body in self.bodies]
            for row, (homecoming, body) in enumerate(zip(homecomings, self.bodies, strict=True)):
                others = [Neighbour(k + 1, place[:3], 0.0) for k, place in enumerate(predicted) if k != row]
                decision = homecoming.steer(body.pose, body.velocity, others, home=True, now_s=tick * dt)
                velocity = np.zeros(5) if homecoming.landing else decision.velocity
                body.command(velocity, tick * dt, flight)
            for body in self.bodies:
                body.step(dt, tick * dt, flight)
            self._note_separation(np.array([body.pose for body in self.bodies]))
            yield tick
            if all(homecoming.landing for homecoming in homecomings):
                return
        raise AssertionError("still in the air")
