"""The planner that a mission asks for."""

from __future__ import annotations

from agents.planners.angle_aware import AngleAware
from agents.planners.angle_aware_down import AngleAwareDown
from agents.planners.coverage import CoverageController
from agents.planners.lawnmower import Lawnmower
from agents.planners.persistent import PersistentCoverage
from agents.planners.planner import Planner
from protocol.mission import Mission


def make_planner(mission: Mission, drone: int) -> Planner:
    """By ``controller.planner``, for ``drone`` of the mission."""
    neighbours = len(mission.drones) - 1
    match mission.controller.planner:
        case "coverage":
            return CoverageController(mission, neighbours)
        case "lawnmower":
            return Lawnmower(mission, drone, neighbours)
        case "persistent":
            return PersistentCoverage(mission, drone, neighbours)
        case "angle_aware_down":
            return AngleAwareDown(mission, neighbours)
        case "angle_aware":
            return AngleAware(mission, neighbours)
