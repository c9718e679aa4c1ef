"""Makes keyframes of what a real camera sees: poses each frame, picks those that are worth sending, compresses them.

It runs in a thread of its own beside the agent's loop, which only notes its poses here. A frame is posed where the
camera was when it was exposed: at its stamp less `mission.camera.latency_s`.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from agents.cameras.camera import Camera, Frame
from agents.cameras.opencv import load_opencv
from agents.cameras.pose_history import Moment, PoseHistory
from protocol.errors import CovreconError, VehicleError
from protocol.geometry import Floats
from protocol.keyframe_rule import KeyframeRule, make_keyframe
from protocol.messages import Keyframe
from protocol.mission import Mission

log = logging.getLogger(__name__)

POSE_WAIT_S = 0.1
"""A frame waits so long for the pose after it: two ticks of 20 Hz."""
RETRY_S = 0.2
"""After an error, before the camera is read again."""
SILENCE_S = 2.0
"""A camera without a frame for so long is at fault, though it reports none."""
ASPECT_TOLERANCE = 0.01
"""By how much the shape of an image may differ from the mission's; its pixels are taken to be square."""
CLOSE_S = 5.0
"""How long `close` waits for the thread: a read of the camera and one image's work."""


class CameraFeed:
    """The owner of ``camera``: closes it in the end."""

    def __init__(
        self,
        mission: Mission,
        drone: int,
        camera: Camera,
        publish: Callable[[Keyframe], None],
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """``publish`` is called in the feed's thread; ``now_s``: the clock of the stamps in `note_pose`.

        Raises:
            VehicleError: OpenCV, which compresses the images, is not installed.
        """
        self._cv2 = load_opencv()
        self._drone, self._camera, self._publish, self._now_s = drone, camera, publish, now_s
        self._settings = mission.camera
        self._intrinsics = mission.camera.intrinsics()
        self._rule = KeyframeRule(mission.camera)
        self._poses = PoseHistory()
        self._heard_s = time.monotonic()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="camera feed", daemon=True)
        self.read = 0
        """Frames that the camera gave ..."""
        self.refused = 0
        """... those that were not used, because no pose was near enough or their shape is not the mission's ..."""
        self.published = 0
        """... and those that became keyframes."""
        self.fault = ""
        """What is wrong with the camera, for people; empty while it works."""

    def start(self) -> None:
        self._heard_s = time.monotonic()
        self._thread.start()

    def close(self) -> None:
        """Returns when no more keyframes are published, after some seconds at worst. May be called twice."""
        self._ended.set()
        if self._thread.ident is not None:
            self._thread.join(CLOSE_S)
        self._camera.close()

    def note_pose(
        self,
        stamp_s: float,
        tick: int,
        pose: Floats,
        rotation: Floats | None = None,
        deviations: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """From any thread, each tick: the vehicle's estimate of ``stamp_s``, as in `agents.vehicles.vehicle.Telemetry`.
        Without poses there are no keyframes: none are noted where none are wanted."""
        self._poses.note(stamp_s, tick, pose, rotation, deviations)

    # --- the thread ----------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._ended.is_set():
            try:
                frame = self._camera.read()
                if frame is not None:
                    self._heard_s = time.monotonic()
                    self._take(frame)
                elif time.monotonic() - self._heard_s <= SILENCE_S:
                    continue
            except CovreconError as error:
                self._report(str(error))
                self._ended.wait(RETRY_S)
            else:
                self._report("" if frame is not None else f"no frame for {SILENCE_S:g} s")

    def _report(self, fault: str) -> None:
        if fault != self.fault:
            if fault:
                log.error("drone %d: %s", self._drone, fault)
            else:
                log.info("drone %d: the camera is back", self._drone)
        self.fault = fault

    def _take(self, frame: Frame) -> None:
        self.read += 1
        self._check_shape(frame.image)
        age_s = time.monotonic() - frame.stamp_s
        exposed_s = self._now_s() - age_s - self._settings.latency_s
        self._poses.wait_past(exposed_s, POSE_WAIT_S)
        moment = self._poses.at(exposed_s)
        if moment is None:
            self.refused += 1
            return
        if self._rule.wants(moment.pose[:3], moment.rotation):
            self._publish(self._keyframe(frame.image, moment))
            self.published += 1

    def _check_shape(self, image: NDArray[np.uint8]) -> None:
        height, width = image.shape[:2]
        wished_px, wished_high_px = self._settings.width_px, self._settings.height_px
        if abs(width * wished_high_px / (height * wished_px) - 1) > ASPECT_TOLERANCE:
            self.refused += 1
            raise VehicleError(
                f"camera: its {width} x {height} pixels are not of the shape of the mission's"
                f" {wished_px} x {wished_high_px} (camera.width_px, camera.height_px)"
            )

    def _keyframe(self, image: NDArray[np.uint8], moment: Moment) -> Keyframe:
        return make_keyframe(
            self._drone,
            self.published,
            moment.tick,
            moment.pose[:3],
            moment.rotation,
            self._intrinsics,
            self._jpeg(image),
            deviations=moment.deviations,
        )

    def _jpeg(self, image: NDArray[np.uint8]) -> bytes:
        """Of the mission's size."""
        lib = self._cv2
        size = (self._intrinsics.width, self._intrinsics.height)
        if image.shape[1::-1] != size:
            image = lib.resize(image, size, interpolation=lib.INTER_AREA)
        options = [lib.IMWRITE_JPEG_QUALITY, self._settings.jpeg_quality]
        done, jpeg = lib.imencode(".jpg", lib.cvtColor(image, lib.COLOR_RGB2BGR), options)
        if not done:
            raise VehicleError("camera: OpenCV cannot compress its image")
        return bytes(jpeg)
