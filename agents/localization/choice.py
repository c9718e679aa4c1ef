"""Which source of poses a mission asks for."""

from __future__ import annotations

from agents.localization.pose_source import PoseSource, VehicleEstimate
from protocol.bus import Bus
from protocol.mission import Mission


def make_pose_source(mission: Mission, drone: int, bus: Bus, *, lockstep: bool) -> PoseSource:
    if mission.localization.source == "vehicle":
        return VehicleEstimate()
    from agents.localization.lidar import LidarOdometry  # SciPy's trees are not wanted in memory without a lidar

    return LidarOdometry(mission, drone, bus, lockstep=lockstep)
