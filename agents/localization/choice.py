"""Which source of poses a mission asks for."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from agents.localization.pose_source import PoseSource, VehicleEstimate
from agents.vehicles.vehicle import SeenPose
from protocol.bus import Bus
from protocol.geometry import Floats
from protocol.mission import Mission
from protocol.news import Tell


def make_pose_source(
    mission: Mission,
    drone: int,
    bus: Bus,
    *,
    lockstep: bool,
    now_s: Callable[[], float] = time.monotonic,
    aid: Callable[[SeenPose], None] = lambda _seen: None,
    others: Callable[[int], Floats] = lambda _tick: np.zeros((0, 4)),
    tell: Tell = lambda _level, _kind, _text: None,
) -> PoseSource:
    """``now_s``: the clock by which the agent judges silence; ``aid`` takes what the vehicle's own estimator may know;
    ``others``: where the other drones said to be before a tick, (n, 4) with the deviation; ``tell`` tells people."""
    if mission.localization.source == "vehicle":
        return VehicleEstimate()
    if mission.localization.source == "mocap":
        from agents.localization.motion_capture import MotionCapture

        return MotionCapture(mission, drone, bus, lockstep=lockstep, now_s=now_s, aid=aid, others=others, tell=tell)
    from agents.localization.lidar import LidarOdometry  # SciPy's trees are not wanted in memory without a lidar

    return LidarOdometry(mission, drone, bus, lockstep=lockstep)
