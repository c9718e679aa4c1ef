"""A real camera's frames become posed keyframes, in a thread that nothing waits for."""

from __future__ import annotations

import io
import queue
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from agents.cameras.camera import Frame
from agents.cameras.feed import RETRY_S, CameraFeed
from agents.cameras.pose_history import BEYOND_MAX_S
from protocol.errors import BusError, CovreconError, VehicleError
from protocol.geometry import Floats, camera_rotation
from protocol.map_settings import Camera
from protocol.messages import Keyframe
from protocol.mission import Drone, Mission
from protocol.wire import decode, encode

PATIENCE_S = 20.0
READ_WAIT_S = 0.01
LATENCY_S = 0.1
TICK_S = 0.05
BEHIND_S = 5000.0
"""How far the agent's clock is behind the camera's."""
MISSION = Mission(
    drones=(Drone(id=7, start=(0.0, 0.0, 2.0, 0.0, 1.3)),),
    camera=Camera(width_px=320, height_px=180, keyframe_baseline_m=0.12, latency_s=LATENCY_S),
)


class ScriptedCamera:
    """Gives what it is told to give."""

    def __init__(self) -> None:
        self.script: queue.SimpleQueue[Frame | CovreconError] = queue.SimpleQueue()
        self.closed = 0

    def read(self) -> Frame | None:
        try:
            next_one = self.script.get(timeout=READ_WAIT_S)
        except queue.Empty:
            return None
        if isinstance(next_one, CovreconError):
            raise next_one
        return next_one

    def close(self) -> None:
        self.closed += 1


@dataclass
class Bench:
    mission: Mission = MISSION
    camera: ScriptedCamera = field(default_factory=ScriptedCamera)
    sent: queue.SimpleQueue[Keyframe] = field(default_factory=queue.SimpleQueue)
    refusals: list[CovreconError] = field(default_factory=list)
    """What publishing fails with, one after the other."""
    feed: CameraFeed = field(init=False)
    began_s: float = 0.0
    """By the camera's clock: when the first pose was true."""

    def __post_init__(self) -> None:
        self.feed = CameraFeed(self.mission, 7, self.camera, self._publish, lambda: time.monotonic() - BEHIND_S)
        self.began_s = time.monotonic() - 3.0

    def _publish(self, keyframe: Keyframe) -> None:
        if self.refusals:
            raise self.refusals.pop(0)
        self.sent.put(keyframe)

    def note_poses(self, poses: list[Floats], rotation: Floats | None = None) -> None:
        for k, pose in enumerate(poses):
            self.feed.note_pose(self.began_s + k * TICK_S - BEHIND_S, 100 + k, pose, rotation)

    def show(self, tick: float, image: NDArray[np.uint8] | None = None) -> None:
        """A frame that was exposed so many ticks after the first pose."""
        image = picture() if image is None else image
        self.camera.script.put(Frame(image, self.began_s + tick * TICK_S + LATENCY_S))

    def next_keyframe(self) -> Keyframe:
        return self.sent.get(timeout=PATIENCE_S)


@pytest.fixture
def bench() -> Iterator[Bench]:
    new = Bench()
    new.feed.start()
    yield new
    new.feed.close()


def wait_for(condition: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline_s
        threading.Event().wait(0.002)


def picture(width: int = 320, height: int = 180) -> NDArray[np.uint8]:
    """Red on the left, blue on the right."""
    image = np.zeros((height, width, 3), np.uint8)
    image[:, : width // 2, 0] = image[:, width // 2 :, 2] = 200
    return image


def track(count: int, step_m: float = 0.05) -> list[Floats]:
    """Poses along x that turn slowly."""
    return [np.array([k * step_m, 1.0, 2.0, 0.01 * k, 1.3]) for k in range(count)]


def pixels(keyframe: Keyframe) -> NDArray[np.uint8]:
    return np.array(Image.open(io.BytesIO(keyframe.jpeg)))


def test_a_keyframe_lies_where_the_camera_was_when_it_was_exposed(bench: Bench) -> None:
    bench.note_poses(track(10))
    bench.show(3.5)

    keyframe = bench.next_keyframe()

    assert keyframe.position == pytest.approx((0.175, 1.0, 2.0), abs=1e-3)
    assert np.array(keyframe.rotation) == pytest.approx(camera_rotation(0.035, 1.3), abs=1e-3)
    assert (keyframe.drone, keyframe.sequence, keyframe.tick) == (7, 0, 103)
    assert decode(Keyframe, encode(keyframe)) == keyframe


def test_a_camera_that_tilts_with_the_airframe_is_posed_by_its_rotation(bench: Bench) -> None:
    tilted = camera_rotation(1.0, 0.4)
    bench.note_poses(track(10), tilted)
    bench.show(3.5)

    assert np.array(bench.next_keyframe().rotation) == pytest.approx(tilted)


def test_a_keyframe_has_the_missions_pinhole_and_the_cameras_colours(bench: Bench) -> None:
    bench.note_poses(track(10))
    bench.show(3)

    keyframe, intrinsics = bench.next_keyframe(), MISSION.camera.intrinsics()

    assert (keyframe.width, keyframe.height) == (320, 180)
    assert (keyframe.fx, keyframe.fy, keyframe.cx, keyframe.cy) == (
        intrinsics.fx,
        intrinsics.fy,
        intrinsics.cx,
        intrinsics.cy,
    )
    assert np.abs(pixels(keyframe).astype(int) - picture())[:, 10:150].max() < 8


def test_images_of_another_size_and_the_same_shape_are_resized(bench: Bench) -> None:
    bench.note_poses(track(10))
    bench.show(3, picture(1280, 720))

    assert np.abs(pixels(bench.next_keyframe()).astype(int) - picture())[:, 10:150].max() < 8


def test_what_is_finer_than_the_missions_pixels_is_averaged(bench: Bench) -> None:
    bench.note_poses(track(10))
    stripes = np.zeros((720, 1280, 3), np.uint8)
    stripes[:, ::2] = 200
    bench.show(3, stripes)

    assert np.abs(pixels(bench.next_keyframe()).astype(int) - 100).max() < 8


def test_the_missions_quality_decides_how_large_a_keyframe_is() -> None:
    sizes = []
    for quality in (30, 95):
        camera = MISSION.camera.model_copy(update={"jpeg_quality": quality})
        bench = Bench(MISSION.model_copy(update={"camera": camera}))
        bench.feed.start()
        bench.note_poses(track(10))
        bench.show(3, np.random.default_rng(1).integers(0, 255, (180, 320, 3), np.uint8))
        sizes.append(len(bench.next_keyframe().jpeg))
        bench.feed.close()

    assert sizes[0] < 0.5 * sizes[1]


def test_an_image_of_another_shape_is_a_fault_and_not_a_keyframe(bench: Bench) -> None:
    bench.note_poses(track(10))
    bench.show(3, picture(640, 480))
    wait_for(lambda: bool(bench.feed.fault))
    assert bench.feed.fault == (
        "camera: its 640 x 480 pixels are not of the shape of the mission's 320 x 180 (camera.width_px,"
        " camera.height_px)"
    )
    bench.show(4, picture(320, 181))

    assert bench.next_keyframe().tick == 104
    wait_for(lambda: not bench.feed.fault)
    assert (bench.feed.read, bench.feed.refused, bench.feed.published) == (2, 1, 1)


def test_only_frames_that_moved_enough_become_keyframes(bench: Bench) -> None:
    bench.note_poses(track(20))
    for tick in range(10):
        bench.show(tick)

    wait_for(lambda: bench.feed.read == 10)
    bench.show(15)

    keyframes = [bench.next_keyframe() for _ in range(5)]
    assert [keyframe.tick for keyframe in keyframes] == [100, 103, 106, 109, 115]
    assert [keyframe.sequence for keyframe in keyframes] == list(range(5))
    assert bench.feed.refused == 0


@pytest.mark.parametrize("tick", [-BEYOND_MAX_S / TICK_S - 0.1, 9 + BEYOND_MAX_S / TICK_S + 0.1])
def test_a_frame_without_a_pose_near_it_is_refused_and_counted(bench: Bench, tick: float) -> None:
    bench.note_poses(track(10))
    bench.show(tick)

    wait_for(lambda: bench.feed.refused == 1)
    assert (bench.feed.read, bench.feed.published, bench.feed.fault) == (1, 0, "")


def test_a_frame_waits_for_the_pose_after_it(bench: Bench) -> None:
    bench.note_poses(track(4))
    exposed_tick = 3.5
    bench.show(exposed_tick)
    wait_for(lambda: bench.feed.read == 1)
    bench.note_poses(track(6))  # the first four again, and two more

    assert bench.next_keyframe().position[0] == pytest.approx(exposed_tick * 0.05, abs=1e-3)


def test_a_camera_that_fails_is_reported_and_read_again(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    bench.note_poses(track(10))
    for _ in range(2):
        bench.camera.script.put(VehicleError("camera rtsp://x: lost; trying again"))
    wait_for(lambda: bool(bench.feed.fault))
    assert bench.feed.fault == "camera rtsp://x: lost; trying again"
    bench.show(3)

    bench.next_keyframe()
    wait_for(lambda: not bench.feed.fault)
    assert [record.levelname for record in caplog.records].count("ERROR") == 1, "a fault is told once"


def test_a_camera_that_fails_at_once_is_not_read_again_at_once(bench: Bench) -> None:
    began_s = time.monotonic()
    for _ in range(1000):
        bench.camera.script.put(VehicleError("gone"))

    wait_for(lambda: bench.camera.script.qsize() <= 998)

    assert time.monotonic() - began_s >= RETRY_S


def test_a_camera_that_gives_nothing_for_long_is_at_fault(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("agents.cameras.feed.SILENCE_S", 0.05)

    wait_for(lambda: bench.feed.fault == "no frame for 0.05 s")


def test_a_keyframe_that_cannot_be_published_is_reported_and_its_number_used_again(bench: Bench) -> None:
    bench.refusals.append(BusError("the bus is closed"))
    bench.note_poses(track(20))
    bench.show(3)
    wait_for(lambda: bench.feed.fault == "the bus is closed")
    bench.show(9)

    assert bench.next_keyframe().sequence == 0


def test_noting_a_pose_does_not_wait_for_a_camera_that_hangs() -> None:
    released = threading.Event()

    class Hanging(ScriptedCamera):
        def read(self) -> Frame | None:
            released.wait(PATIENCE_S)
            return None

    bench = Bench(camera=Hanging())
    bench.feed.start()
    bench.note_poses(track(100))  # returns, or the test does not
    released.set()
    bench.feed.close()

    assert bench.camera.closed


def test_a_feed_is_closed_once_or_twice_or_unstarted() -> None:
    bench = Bench()
    bench.feed.close()
    assert bench.camera.closed == 1

    bench = Bench()
    bench.feed.start()
    bench.feed.close()
    bench.feed.close()
    assert not bench.feed._thread.is_alive()
    bench.show(3)
    assert bench.feed.read == 0


def test_without_opencv_a_feed_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> object:
        raise ImportError(name)

    monkeypatch.setattr("importlib.import_module", absent)

    with pytest.raises(VehicleError, match="install the extra 'camera'"):
        Bench()
