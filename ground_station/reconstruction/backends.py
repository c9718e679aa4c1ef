"""Which reconstructor a mission asks for."""

from __future__ import annotations

from ground_station.reconstruction.depth_reconstructor import DepthReconstructor
from ground_station.reconstruction.plane_sweep_reconstructor import PlaneSweepReconstructor
from ground_station.reconstruction.reconstructor import NullReconstructor, Reconstructor
from protocol.mission import Mission


def make_reconstructor(mission: Mission) -> Reconstructor:
    """A new, empty one. Raises `ReconstructionError` if the map would not fit in memory."""
    if mission.reconstruction.backend == "none":
        return NullReconstructor()
    if mission.reconstruction.backend == "depth":
        return DepthReconstructor(mission)
    return PlaneSweepReconstructor(mission)
