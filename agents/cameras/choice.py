"""Which camera a mission gives a drone."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from protocol import topics
from protocol.bus import Bus
from protocol.mission import Mission

if TYPE_CHECKING:
    from agents.cameras.feed import CameraFeed


def make_feed(mission: Mission, drone: int, bus: Bus, *, now_s: Callable[[], float]) -> CameraFeed | None:
    """None for a drone without a camera of its own. ``now_s``: the clock of its telemetry's stamps.

    Raises:
        VehicleError: OpenCV is not installed.
    """
    source = mission.drone(drone).camera
    if not source:
        return None
    from agents.cameras.feed import CameraFeed
    from agents.cameras.opencv import OpenCvCamera

    camera = OpenCvCamera(source, mission.camera.width_px, mission.camera.height_px)
    return CameraFeed(mission, drone, camera, lambda keyframe: bus.put(topics.KEYFRAME, keyframe, drone), now_s)
