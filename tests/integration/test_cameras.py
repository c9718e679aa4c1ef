"""Real cameras: a video file, and a camera on the network that stalls, dies and comes back."""

from __future__ import annotations

import io
import queue
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from agents.cameras.camera import Frame
from agents.cameras.feed import CameraFeed
from agents.cameras.frame_clock import SETTLED_S
from agents.cameras.opencv import SILENCE_S, OpenCvCamera
from faults.rtsp_server import RATE_HZ, RtspServer, draw_number, read_number
from protocol.errors import VehicleError
from protocol.map_settings import Camera
from protocol.messages import Keyframe
from protocol.mission import Drone, Mission

pytestmark = pytest.mark.light

PATIENCE_S = 20.0
SIZE = (512, 288)
"""What the cameras send; the mission wants half of it."""
SPEED_MPS, BASELINE_M = 0.5, 0.05
PERIOD_S = 1 / RATE_HZ
MISSION = Mission(
    drones=(Drone(id=3, start=(0.0, 0.0, 2.0, 0.0, 1.3)),),
    camera=Camera(width_px=256, height_px=144, keyframe_baseline_m=BASELINE_M),
)


@pytest.fixture
def server() -> Iterator[RtspServer]:
    with RtspServer(*SIZE) as new:
        yield new


@pytest.fixture
def opened() -> Iterator[Callable[[str], OpenCvCamera]]:
    cameras: list[OpenCvCamera] = []

    def open_camera(source: str) -> OpenCvCamera:
        cameras.append(OpenCvCamera(source, *SIZE))
        return cameras[-1]

    yield open_camera
    for camera in cameras:
        camera.close()


def frames(camera: OpenCvCamera, count: int) -> list[Frame]:
    """The next ones, whatever goes wrong in between."""
    came: list[Frame] = []
    deadline_s = time.monotonic() + PATIENCE_S
    while len(came) < count:
        assert time.monotonic() < deadline_s, f"{len(came)} frames"
        try:
            frame = camera.read()
        except VehicleError:
            continue
        if frame is not None:
            came.append(frame)
    return came


def failure(camera: OpenCvCamera) -> str:
    """What its next failure says."""
    deadline_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline_s:
        try:
            camera.read()
        except VehicleError as error:
            return str(error)
    raise AssertionError("it does not fail")


def read_to_the_end(camera: OpenCvCamera, came: list[Frame]) -> None:
    while True:
        if (frame := camera.read()) is not None:
            assert time.monotonic() >= frame.stamp_s, "before its time"
            came.append(frame)


def numbers(came: list[Frame]) -> list[int]:
    return [read_number(frame.image) for frame in came]


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """Forty numbered frames at 50 a second, a stripe at the bottom of them red."""
    path = tmp_path / "flight.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 50.0, SIZE)
    for number in range(40):
        image = draw_number(number, *SIZE)
        image[-16:] = (0, 0, 200)  # OpenCV's order: blue, green, red
        writer.write(image)
    writer.release()
    return path


# --- a file ----------------------------------------------------------------------------------------------------------


def test_a_video_is_played_at_its_own_rate_in_order_until_it_ends(
    video: Path, opened: Callable[[str], OpenCvCamera]
) -> None:
    camera = opened(str(video))
    came: list[Frame] = []
    with pytest.raises(VehicleError, match=r"flight\.avi: the file has ended"):
        read_to_the_end(camera, came)

    shown = np.array(numbers(came))
    assert len(came) > 5
    assert np.all(np.diff(shown) > 0)
    assert shown[-1] == 39
    assert np.diff([frame.stamp_s for frame in came]) == pytest.approx(np.diff(shown) / 50, abs=0.002)
    assert np.allclose(came[0].image[-2, -2], (200, 0, 0), atol=12), "RGB"
    with pytest.raises(VehicleError, match="has ended"):
        camera.read()


def test_a_file_that_is_missing_or_no_video_says_so(tmp_path: Path, opened: Callable[[str], OpenCvCamera]) -> None:
    (tmp_path / "notes.mp4").write_text("nothing to see")

    for path in (tmp_path / "none.mp4", tmp_path / "notes.mp4"):
        assert failure(opened(str(path))) == f"camera {path}: cannot be opened"


def test_a_device_that_is_not_there_is_reported_and_tried_again(opened: Callable[[str], OpenCvCamera]) -> None:
    camera = opened("/dev/video-none")

    for _ in range(2):
        assert failure(camera) == "camera /dev/video-none: cannot be opened; trying again"


class ScriptedDevice:
    """Stands for `cv2.VideoCapture` of a V4L2 device, of which a test has none: it is unplugged after 30 frames."""

    asked: ClassVar[list[tuple[object, ...]]] = []

    def __init__(self, *arguments: object) -> None:
        self.asked.append(arguments)
        self._began_s = time.monotonic()
        self._number = 0

    def isOpened(self) -> bool:  # noqa: N802  # OpenCV's name
        return True

    def set(self, setting: int, value: float) -> bool:
        self.asked.append((setting, value))
        return True

    def get(self, setting: int) -> float:
        assert setting == cv2.CAP_PROP_POS_MSEC
        return 1000 * self._number * PERIOD_S

    def grab(self) -> bool:
        self._number += 1
        threading.Event().wait(self._began_s + self._number * PERIOD_S - time.monotonic())
        return self._number <= 30

    def retrieve(self) -> tuple[bool, NDArray[np.uint8]]:
        return True, draw_number(self._number, *SIZE)

    def release(self) -> None:
        self.asked.append(())


def test_a_device_is_asked_for_the_missions_size_and_no_queue_and_opened_anew_when_it_was_unplugged(
    opened: Callable[[str], OpenCvCamera], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cv2, "VideoCapture", ScriptedDevice)
    ScriptedDevice.asked.clear()
    camera = opened("/dev/video0")

    assert numbers(frames(camera, 3))[0] >= SETTLED_S * RATE_HZ
    assert failure(camera) == "camera /dev/video0: lost; trying again"
    assert numbers(frames(camera, 1))[0] <= 30
    assert ScriptedDevice.asked[:5] == [
        ("/dev/video0", cv2.CAP_V4L2),
        (cv2.CAP_PROP_FRAME_WIDTH, SIZE[0]),
        (cv2.CAP_PROP_FRAME_HEIGHT, SIZE[1]),
        (cv2.CAP_PROP_BUFFERSIZE, 1),
        (),
    ]


# --- on the network --------------------------------------------------------------------------------------------------


def test_frames_of_a_network_camera_come_in_order_newest_first_and_with_little_delay(
    server: RtspServer, opened: Callable[[str], OpenCvCamera]
) -> None:
    came = frames(opened(server.url), 50)

    shown = numbers(came)
    late_s = np.array([frame.stamp_s - server.sent_s[number] for frame, number in zip(came, shown, strict=True)])
    assert shown[0] >= SETTLED_S * RATE_HZ, "what lay in queues while the stream was opened is left out"
    assert np.all(np.diff(shown) > 0)
    assert np.median(np.diff(shown)) == 1
    assert np.median(np.abs(late_s)) < 0.01
    assert np.abs(late_s).max() < PERIOD_S


def test_a_slow_reader_gets_the_newest_frame_not_the_next(
    server: RtspServer, opened: Callable[[str], OpenCvCamera]
) -> None:
    camera = opened(server.url)
    first = numbers(frames(camera, 1))[0]
    taken = camera.taken
    wait_for(lambda: camera.taken >= taken + 12)

    (frame,) = frames(camera, 1)

    assert read_number(frame.image) >= first + 10
    assert time.monotonic() - frame.stamp_s < 5 * PERIOD_S


def test_a_network_camera_that_dies_is_reported_and_found_again(opened: Callable[[str], OpenCvCamera]) -> None:
    with RtspServer(*SIZE) as server:
        camera = opened(server.url.replace("rtsp://", "rtsp://pilot:secret@"))
        assert numbers(frames(camera, 5))
    assert failure(camera) in {f"camera {server.url}: {fault}; trying again" for fault in ("lost", "cannot be opened")}

    with RtspServer(*SIZE, port=server.port) as again:
        came = frames(camera, 10)
        late_s = [frame.stamp_s - again.sent_s[read_number(frame.image)] for frame in came]
    assert np.abs(late_s).max() < PERIOD_S


def test_a_network_camera_that_falls_silent_is_opened_anew(
    server: RtspServer, opened: Callable[[str], OpenCvCamera]
) -> None:
    camera = opened(server.url)
    frames(camera, 1)
    server.flows.clear()
    silent_s = time.monotonic()
    assert failure(camera).endswith("lost; trying again")
    assert time.monotonic() - silent_s < SILENCE_S + 2.0

    server.flows.set()
    assert numbers(frames(camera, 3))


# --- to keyframes ----------------------------------------------------------------------------------------------------


class Flight:
    """A drone that flies along x and films: a thread notes its poses, twenty a second."""

    def __init__(self, url: str) -> None:
        self.keyframes: queue.SimpleQueue[Keyframe] = queue.SimpleQueue()
        self.camera = OpenCvCamera(url, *SIZE)
        self.feed = CameraFeed(MISSION, 3, self.camera, self.keyframes.put)
        self._landed = threading.Event()
        self._began_s = time.monotonic()
        self._thread = threading.Thread(target=self._fly)

    def where(self, time_s: float) -> float:
        return SPEED_MPS * (time_s - self._began_s)

    def _fly(self) -> None:
        tick = 0
        while not self._landed.wait(MISSION.tick_s):
            now_s = time.monotonic()
            self.feed.note_pose(now_s, tick, np.array([self.where(now_s), 0.0, 2.0, 0.0, 1.3]))
            tick += 1

    def __enter__(self) -> Flight:
        self._thread.start()
        self.feed.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._landed.set()
        self._thread.join()
        self.feed.close()


def number_of(keyframe: Keyframe) -> int:
    image = np.array(Image.open(io.BytesIO(keyframe.jpeg)))
    return read_number(image)


def off_m(flight: Flight, server: RtspServer, keyframe: Keyframe) -> float:
    """How far the keyframe lies from where the drone was when the camera sent it."""
    return abs(keyframe.position[0] - flight.where(server.sent_s[number_of(keyframe)]))


def test_keyframes_of_a_flying_camera_lie_where_it_was_also_after_it_died_and_came_back() -> None:
    with RtspServer(*SIZE) as server, Flight(server.url) as flight:
        came = [flight.keyframes.get(timeout=PATIENCE_S) for _ in range(15)]
        assert max(off_m(flight, server, keyframe) for keyframe in came) < 0.02
        assert [keyframe.sequence for keyframe in came] == list(range(15))
        assert np.all(np.diff([keyframe.position[0] for keyframe in came]) >= BASELINE_M)
        assert (came[0].width, came[0].height) == (256, 144)

        server.close()
        wait_for(lambda: bool(flight.feed.fault))
        while not flight.keyframes.empty():
            flight.keyframes.get()
        with RtspServer(*SIZE, port=server.port) as again:
            later = [flight.keyframes.get(timeout=PATIENCE_S) for _ in range(5)]
            assert max(off_m(flight, again, keyframe) for keyframe in later) < 0.02
            assert not flight.feed.fault


def wait_for(condition: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline_s
        threading.Event().wait(0.005)
