"""Which reconstructor a mission asks for."""

from __future__ import annotations

from importlib import import_module
from typing import cast

from ground_station.external_map import ExternalMap
from ground_station.reconstruction.depth_reconstructor import DepthReconstructor
from ground_station.reconstruction.external_reconstructor import ExternalReconstructor
from ground_station.reconstruction.memory import check_memory
from ground_station.reconstruction.plane_sweep_reconstructor import PlaneSweepReconstructor
from ground_station.reconstruction.reconstructor import NullReconstructor, Reconstructor
from protocol.errors import ReconstructionError
from protocol.mission import Mission


def make_reconstructor(mission: Mission, external: ExternalMap | None = None) -> Reconstructor:
    """A new, empty one; ``external``: the process that a mission with that backend flies with.

    Raises:
        ReconstructionError: the map would take more memory than the mission allows, is another process's that is not
            here, or its method lacks what it needs.
    """
    check_memory(mission)
    match mission.reconstruction.backend:
        case "none":
            return NullReconstructor()
        case "depth":
            return DepthReconstructor(mission)
        case "external" if external is not None:
            return ExternalReconstructor(external)
        case "external":
            raise ReconstructionError(
                'reconstruction.backend "external": that process makes its map in flight alone; choose another one here'
            )
        case "learned":
            # By name: it imports torch, which only missions that ask for it need.
            learned = import_module("ground_station.reconstruction.learned.learned_reconstructor")
            return cast("Reconstructor", learned.LearnedReconstructor(mission))
        case "plane_sweep":
            return PlaneSweepReconstructor(mission)
