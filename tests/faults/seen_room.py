"""A room of boxes and what drones in it have seen free, without images: rays through cells, as a perfect camera's."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from agents.climbing import Climbing
from agents.obstacles import Obstacles
from agents.planners.planner import Decision
from faults.team_flight import TeamFlight
from protocol.geometry import Floats, camera_rotation
from protocol.messages import FreeCells
from protocol.mission import Drone, Mission
from protocol.obstacle_grid import Cells, ObstacleGrid

RAYS = (24, 14)
"""Of one look, across and down."""
LOOK_TICKS = 10
"""Between two looks, and two maps."""


def room_mission(starts: Sequence[tuple[float, ...]] = (), **tables: object) -> Mission:
    """A small room: what stands in it is up to 1.2 m high, and nothing above that."""
    places = starts or ((-1.0, 0.0, 2.0), (1.0, 0.0, 2.0))
    drones = tuple(Drone(id=k, start=(*place, 0.0, 1.3)) for k, place in enumerate(places, start=1))
    given: dict[str, object] = {
        "target": {"lower_m": (-1.5, -1.5, 0.0), "upper_m": (1.5, 1.5, 1.2)},
        "flight": {
            "lower_m": (-2.0, -2.0, 0.5),
            "upper_m": (2.0, 2.0, 3.0),
            "obstacles": {"enabled": True},
        },
        "drones": drones,
    }
    return Mission.model_validate(given | tables)


def boxes_of(seed: int, count: int = 5) -> Floats:
    """(count, 2, 3) corners of boxes on the floor of that room, the floor itself the last."""
    rng = np.random.default_rng(seed)
    low = np.column_stack([rng.uniform(-1.5, 1.1, (count, 2)), np.zeros(count)])
    size = np.column_stack([rng.uniform(0.2, 0.9, (count, 2)), rng.uniform(0.2, 1.2, count)])
    floor = np.array([[[-9.0, -9.0, -1.0], [9.0, 9.0, 0.0]]])
    return np.concatenate([np.stack([low, low + size], axis=1), floor])


def distance_m(boxes: Floats, place: Floats) -> float:
    """Of ``place`` (3,) from the nearest of ``boxes``."""
    beyond = np.maximum(np.maximum(boxes[:, 0] - place, place - boxes[:, 1]), 0.0)
    return float(np.linalg.norm(beyond, axis=1).min())


def rough_map(grid: ObstacleGrid, seed: int, share: float = 0.9) -> Cells:
    """Free but for a random part of the cells, of which some lie together."""
    rng = np.random.default_rng(seed)
    free = rng.random(grid.shape) < share
    for _ in range(4):
        low = [int(rng.integers(0, length)) for length in grid.shape]
        i, j, k = (slice(at, at + int(rng.integers(1, 9))) for at in low)
        free[i, j, k] = False
    return np.asarray(free)


def not_free(grid: ObstacleGrid, free: Cells, place: Floats) -> float:
    """Distance of ``place`` (3,) from all cells that are not free, cell by cell."""
    low = grid.origin + grid.cell_m * np.argwhere(~free)
    return distance_m(np.stack([low, low + grid.cell_m], axis=1), place) if len(low) else math.inf


@dataclass
class RoomFlight(TeamFlight):
    """A team that maps the room as it flies; every drone heeds the map, and climbs where it is held."""

    boxes: Floats = field(default_factory=lambda: boxes_of(0))
    climbs: bool = True
    pull: Floats | None = None
    """(5,) what every planner wants instead of what it would."""
    sees: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        self.obstacles = [Obstacles(self.mission) for _ in self.bodies]
        self.climbing = [Climbing(self.mission, obstacles) for obstacles in self.obstacles]
        self.grid = self.obstacles[0].grid
        centres = self.grid.origin + self.grid.cell_m * (np.argwhere(np.ones(self.grid.shape, np.bool_)) + 0.5)
        low, high = centres - self.grid.cell_m / 2, centres + self.grid.cell_m / 2
        solid = np.zeros(len(centres), np.bool_)
        for box in self.boxes:
            solid |= ((low < box[1]) & (high > box[0])).all(axis=1)
        self._solid = solid.reshape(self.grid.shape)
        self.seen = np.zeros(self.grid.shape, np.bool_)
        self.nearest_m = math.inf
        """Of any drone to any box so far."""
        for row, planner in enumerate(self.planners):
            planner.heed(self.obstacles[row])
            self._obey_climbing(row)

    def _obey_climbing(self, row: int) -> None:
        """As the agent does: what a planner decides is flown unless the drone climbs."""
        planner, climbing, decide = self.planners[row], self.climbing[row], self.planners[row].decide

        def decide_or_climb(pose: Floats, velocity: Floats, neighbours: object, *others: object) -> Decision:
            now_s = self.tick * self.mission.tick_s
            wish = climbing.wish(pose[:3], now_s)
            if wish is not None:
                return planner.steer(pose, velocity, neighbours, wish)  # type: ignore[arg-type]
            if self.pull is None:
                decision = decide(pose, velocity, neighbours, *others)  # type: ignore[arg-type]
            else:
                decision = planner.steer(pose, velocity, neighbours, self.pull)  # type: ignore[arg-type]
            if self.climbs:
                climbing.look(pose[:3], decision, now_s)
            return decision

        planner.decide = decide_or_climb  # type: ignore[method-assign, assignment]

    def step(self) -> None:
        if self.tick % LOOK_TICKS == 0:
            for body in self.bodies if self.sees else ():
                self._look(body.pose)
            message = FreeCells(tick=self.tick, packed=self.grid.pack(self.seen))
            for obstacles in self.obstacles:
                obstacles.hear(message)
                obstacles.advance(self.tick)
        super().step()
        for body in self.bodies:
            self.nearest_m = min(self.nearest_m, distance_m(self.boxes, body.pose[:3]))

    def _look(self, pose: Floats) -> None:
        """Cells that a ray passes before it meets a box are free."""
        across, down = np.meshgrid(np.linspace(-0.75, 0.75, RAYS[0]), np.linspace(-0.42, 0.42, RAYS[1]))
        rays = np.stack([across, down, np.ones_like(across)], axis=-1).reshape(-1, 3)
        rays = rays / np.linalg.norm(rays, axis=1, keepdims=True) @ camera_rotation(pose[3], pose[4]).T
        going = np.ones(len(rays), np.bool_)
        for length in np.arange(0.0, 4.0, self.grid.cell_m / 2):
            cells = np.floor((pose[:3] + length * rays - self.grid.origin) / self.grid.cell_m).astype(int)
            inside = ((cells >= 0) & (cells < self.grid.shape)).all(axis=1)
            hit = np.zeros(len(rays), np.bool_)
            hit[inside] = self._solid[tuple(cells[inside].T)]
            going &= ~hit
            passed = cells[going & inside]
            self.seen[tuple(passed.T)] = True
