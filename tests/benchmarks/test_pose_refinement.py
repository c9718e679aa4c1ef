"""Mending the pose of a keyframe, against computing its depth."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from ground_station.reconstruction.plane_sweep_reconstructor import PlaneSweepReconstructor
from ground_station.reconstruction.reconstructor import Keyframe
from protocol.geometry import camera_rotation
from protocol.map_settings import Reconstruction
from protocol.mission import Drone, Mission
from sim_bridge.camera import Camera
from sim_bridge.scenes.random_room import random_room
from sim_bridge.scenes.scene import pack_scene

Record = Callable[..., None]
KEYFRAMES = 120
COMPILED = 20
"""The first are not timed: numba compiles, and there is little to compare with."""
ROOM = 1


def test_pose_refinement(record: Record) -> None:
    """CPU a keyframe of a flight to and fro through a random room; the bar is 15 ms beside the depth."""
    mission = Mission(drones=(Drone(id=1, start=(0.0, 0.0, 2.0, 0.0, 1.3)),))
    camera, intrinsics = (
        Camera(pack_scene(*random_room(ROOM)), mission.camera.intrinsics()),
        mission.camera.intrinsics(),
    )
    keyframes = []
    for n in range(KEYFRAMES):
        along = 2.0 * np.sin(0.06 * n)
        pose = (along, 0.4 * np.sin(0.11 * n), 1.7, 0.3 * np.sin(0.1 * n), 1.35)
        rotation = camera_rotation(pose[3], pose[4])
        keyframes.append(Keyframe(1, n, 5 * n, camera.render(pose), np.array(pose[:3]), rotation, intrinsics))
    times = {}
    for refined in (False, True):
        settings = Reconstruction(refine_poses=refined, workers=1)
        reconstructor = PlaneSweepReconstructor(mission.model_copy(update={"reconstruction": settings}))
        reconstructor.add(keyframes[:COMPILED])
        reconstructor.mesh()
        began = time.process_time()
        for keyframe in keyframes[COMPILED:]:
            reconstructor.add([keyframe])
        reconstructor.flush()
        times[refined] = (time.process_time() - began) / (KEYFRAMES - COMPILED)
        assert reconstructor.statistics().fused > KEYFRAMES / 2
    cost = times[True] - times[False]
    record("pose_refinement", cost * 1e3, "ms CPU", "depth and fusion of a keyframe", times[False] / cost)
