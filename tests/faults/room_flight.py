"""The keyframes of drones that fly to and fro through a random room, rendered as the simulator does: for benchmarks."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image

from protocol.geometry import camera_rotation
from protocol.keyframe_rule import make_keyframe
from protocol.map_settings import Reconstruction
from protocol.messages import Keyframe
from protocol.mission import Drone, Mission
from sim_bridge.camera import Camera
from sim_bridge.scenes.random_room import random_room
from sim_bridge.scenes.scene import pack_scene

ROOM = 1
TICKS_APART = 5
CORNERS = ((-1.5, -1.5), (1.5, -1.5), (-1.5, 1.5), (1.5, 1.5))
"""Around each, one drone flies."""
REACH_M, STEP_M = 1.3, 0.13
"""To either side, and between two keyframes: a bit more than cameras wait for."""


def room_mission(drones: int = 1, **reconstruction: object) -> Mission:
    settings = Reconstruction.model_validate(reconstruction)
    team = tuple(Drone(id=n + 1, start=(*CORNERS[n], 1.8, 0.0, 1.3)) for n in range(drones))
    return Mission(drones=team, reconstruction=settings)


def rendered(mission: Mission, count: int) -> list[Keyframe]:
    """``count`` of each drone, as they travel, in the order of their ticks; about 10 ms each."""
    camera = Camera(pack_scene(*random_room(ROOM)), mission.camera.intrinsics())
    return [
        _keyframe(camera, mission, drone.id, number, CORNERS[place])
        for number in range(count)
        for place, drone in enumerate(mission.drones)
    ]


def _keyframe(camera: Camera, mission: Mission, drone: int, number: int, centre: tuple[float, float]) -> Keyframe:
    turn = 0.3 * np.sin(0.1 * number) + drone
    along = abs((STEP_M * number + REACH_M) % (4 * REACH_M) - 2 * REACH_M) - REACH_M
    across = 0.5 * REACH_M * np.sin(0.13 * number + drone)
    pose = (centre[0] + along, centre[1] + across, 1.7, turn, 1.35)
    jpeg = io.BytesIO()
    Image.fromarray(camera.render(pose)).save(jpeg, "JPEG", quality=mission.camera.jpeg_quality)
    rotation = camera_rotation(pose[3], pose[4])
    return make_keyframe(
        drone,
        number,
        TICKS_APART * number,
        np.array(pose[:3]),
        rotation,
        mission.camera.intrinsics(),
        jpeg.getvalue(),
    )
