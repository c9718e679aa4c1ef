"""Cameras that OpenCV reads: an RTSP URL, a V4L2 device, or a video file that is played at its own rate.

A thread of its own takes every frame as soon as it comes and keeps the newest alone, so that none waits in a queue of
the driver, the decoder or the network. OpenCV comes with the extra ``camera`` and is imported where it is used.
"""

from __future__ import annotations

import importlib
import logging
import threading
import time
from types import ModuleType
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from agents.cameras.camera import Frame
from agents.cameras.frame_clock import FrameClock
from protocol.errors import VehicleError

if TYPE_CHECKING:
    import cv2

log = logging.getLogger(__name__)

READ_WAIT_S = 0.5
"""How long `OpenCvCamera.read` waits for a frame; ten frames of a slow camera."""
OPEN_TIMEOUT_S = 5.0
SILENCE_S = 2.0
"""A stream without a packet for so long is opened anew."""
BACKOFF_FIRST_S, BACKOFF_MAX_S = 0.25, 4.0
"""Between two attempts to open; doubled each time until a frame comes."""
DEVICES = "/dev/"
NETWORK = ("rtsp", "rtsps")


def load_opencv() -> ModuleType:
    """The module ``cv2``.

    Raises:
        VehicleError: it is not installed.
    """
    try:
        module = importlib.import_module("cv2")
    except ImportError as error:
        raise VehicleError("a real camera needs OpenCV: install the extra 'camera'") from error
    # Else each attempt to open a camera that is away writes lines of its own; what fails is raised here.
    module.utils.logging.setLogLevel(module.utils.logging.LOG_LEVEL_ERROR)
    return module


class OpenCvCamera:
    """`agents.cameras.camera.Camera`. Opens in the background, and live cameras again whenever they are lost."""

    def __init__(self, source: str, width: int, height: int) -> None:
        """``width`` and ``height`` in pixels: what a V4L2 device is asked for; it may have only something near it.

        Raises:
            VehicleError: OpenCV is not installed.
        """
        self._cv2: Any = load_opencv()
        self._source, self._size = source, (width, height)
        self.name = _without_password(source)
        self.is_live = source.startswith(DEVICES) or urlsplit(source).scheme in NETWORK
        self.taken = 0
        """Frames that came ..."""
        self.unstamped = 0
        """... and those among them of which it is not known when."""
        self._newest: Frame | None = None
        self._fault = ""
        self._changed = threading.Condition()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"camera {self.name}", daemon=True)
        self._thread.start()

    def read(self) -> Frame | None:
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not None, READ_WAIT_S)
            frame, self._newest = self._newest, None
            fault = self._fault
        if frame is not None:
            return Frame(self._cv2.cvtColor(frame.image, self._cv2.COLOR_BGR2RGB), frame.stamp_s)
        if fault:
            raise VehicleError(f"camera {self.name}: {fault}")
        return None

    def close(self) -> None:
        """Waits for the thread: at worst until OpenCV has given up opening."""
        self._closed.set()
        self._thread.join(OPEN_TIMEOUT_S + SILENCE_S)
        if self._thread.is_alive():
            log.warning("camera %s: OpenCV does not return", self.name)

    # --- the thread ----------------------------------------------------------------------------------------------

    def _run(self) -> None:
        backoff_s = BACKOFF_FIRST_S
        while not self._closed.is_set():
            taken = self.taken
            fault = self._watch()
            if self._closed.is_set():
                return
            with self._changed:
                self._fault = f"{fault}; trying again" if self.is_live else fault
            if not self.is_live:
                return
            if self.taken > taken:
                backoff_s = BACKOFF_FIRST_S
            self._closed.wait(backoff_s)
            backoff_s = min(2 * backoff_s, BACKOFF_MAX_S)

    def _watch(self) -> str:
        """Open, and take frames until there are no more; why that is."""
        try:
            capture = self._open()
            try:
                if not capture.isOpened():
                    return "cannot be opened"
                return self._follow(capture) if self.is_live else self._play(capture)
            finally:
                capture.release()
        except self._cv2.error as error:
            return f"OpenCV: {error}"

    def _open(self) -> cv2.VideoCapture:
        lib = self._cv2
        if not self._source.startswith(DEVICES):
            patience = [
                *(lib.CAP_PROP_OPEN_TIMEOUT_MSEC, round(1000 * OPEN_TIMEOUT_S)),
                *(lib.CAP_PROP_READ_TIMEOUT_MSEC, round(1000 * SILENCE_S)),
            ]
            capture: cv2.VideoCapture = lib.VideoCapture(self._source, lib.CAP_FFMPEG, patience)
            return capture
        capture = lib.VideoCapture(self._source, lib.CAP_V4L2)
        capture.set(lib.CAP_PROP_FRAME_WIDTH, self._size[0])
        capture.set(lib.CAP_PROP_FRAME_HEIGHT, self._size[1])
        capture.set(lib.CAP_PROP_BUFFERSIZE, 1)
        return capture

    def _follow(self, capture: cv2.VideoCapture) -> str:
        clock = FrameClock()
        while not self._closed.is_set():
            if not capture.grab():
                return "lost"
            arrival_s = time.monotonic()
            self.taken += 1
            stamp_s = clock.stamp(self._position_s(capture), arrival_s)
            if stamp_s is None:
                self.unstamped += 1
            elif not self._offer(capture, stamp_s):
                return "undecodable"
        return "closed"

    def _play(self, capture: cv2.VideoCapture) -> str:
        began_s = time.monotonic()
        while capture.grab():
            self.taken += 1
            due_s = began_s + self._position_s(capture)
            if self._closed.wait(max(0.0, due_s - time.monotonic())):
                return "closed"
            if not self._offer(capture, due_s):
                return "undecodable"
        return "the file has ended" if self.taken else "the file holds no frame"

    def _position_s(self, capture: cv2.VideoCapture) -> float:
        """The camera's own stamp of the frame that was grabbed last."""
        return float(capture.get(self._cv2.CAP_PROP_POS_MSEC)) / 1000

    def _offer(self, capture: cv2.VideoCapture, stamp_s: float) -> bool:
        done, image = capture.retrieve()
        if done:
            with self._changed:
                self._newest, self._fault = Frame(image, stamp_s), ""  # type: ignore[arg-type]  # 8 bits by default
                self._changed.notify_all()
        return done


def _without_password(source: str) -> str:
    """For logs: what stands before the @ of a URL is nobody's business."""
    parts = urlsplit(source)
    host = parts.netloc.rpartition("@")[2]
    return parts._replace(netloc=host).geturl() if parts.username is not None else source
