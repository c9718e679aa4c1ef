"""A camera that moves while its shutter is open blurs along its motion; one that stands still does not."""

from __future__ import annotations

import io
import math

import numpy as np
import pytest
from PIL import Image

from protocol.geometry import Floats
from protocol.map_settings import Camera as CameraSettings
from protocol.messages import Keyframe
from protocol.mission import Drone, Mission, Simulation
from sim_bridge.camera import Camera
from sim_bridge.exposure import expose, renderings
from sim_bridge.photographer import Photographer, Shot, Sight
from sim_bridge.scenes.scene import Scene, pack_scene
from sim_bridge.scenes.surfaces import Material, join, quad

DOWN = np.array([0.1, 0.2, 1.0, 0.0, math.pi / 2])
"""Looks straight down from 1 m; the image's height lies along x."""
STILL, ALONG_X, ALONG_Y = np.zeros(5), np.array([0.5, 0, 0, 0, 0]), np.array([0, 0.5, 0, 0, 0])
EXPOSURE_S = 0.1
INTRINSICS = CameraSettings(width_px=96, height_px=96).intrinsics()


def speckled() -> Scene:
    corners = [(-3.0, -3.0, 0.0), (3.0, -3.0, 0.0), (3.0, 3.0, 0.0), (-3.0, 3.0, 0.0)]
    texels = np.random.default_rng(1).integers(0, 256, (256, 256, 1), np.uint8).repeat(3, axis=2)
    return pack_scene(join((quad(corners, Material(0)),)), [texels])


CAMERA = Camera(speckled(), INTRINSICS)


def exposed(velocity: Floats, exposure_s: float = EXPOSURE_S) -> np.ndarray:
    return expose(CAMERA, DOWN, velocity, exposure_s, INTRINSICS, 1.0)


def contrast(image: np.ndarray, axis: int) -> float:
    return float((np.diff(image[..., 0].astype(float), axis=axis) ** 2).mean())


@pytest.mark.parametrize(("velocity", "exposure_s"), [(STILL, EXPOSURE_S), (ALONG_X, 0.0)])
def test_who_stands_still_or_has_no_exposure_sees_the_very_bytes_of_before(velocity: Floats, exposure_s: float) -> None:
    assert exposed(velocity, exposure_s).tobytes() == CAMERA.render(DOWN.tolist()).tobytes()


@pytest.mark.parametrize(("velocity", "along", "across"), [(ALONG_X, 0, 1), (ALONG_Y, 1, 0)])
def test_a_moving_image_is_blurred_along_its_motion_and_not_across(velocity: Floats, along: int, across: int) -> None:
    sharp, blurred = exposed(STILL), exposed(velocity)
    assert 3.0 < INTRINSICS.fx * 0.5 * EXPOSURE_S < 4.0, "pixels"
    assert contrast(blurred, along) < 0.55 * contrast(sharp, along)
    # Across, the mean over several speckles lessens contrast too, but less than along, where neighbours share them.
    assert contrast(blurred, along) < 0.75 * contrast(blurred, across)


def test_the_longer_the_exposure_the_more_blur() -> None:
    blurs = [contrast(exposed(ALONG_X, seconds), 0) for seconds in (0.0, 0.02, 0.05, 0.1)]
    assert blurs == sorted(blurs, reverse=True)
    assert blurs[-1] < 0.3 * blurs[0]


def test_a_camera_that_turns_blurs_too() -> None:
    assert contrast(exposed(np.array([0, 0, 0, 0, 0.5])), 0) < 0.55 * contrast(exposed(STILL), 0)


def test_light_is_added_up_and_not_the_values_that_stand_for_it() -> None:
    """Half the time black and half white is half the light, which sRGB writes as 188."""

    class Flicker(Camera):
        def __init__(self) -> None:
            self.calls = 0

        def render(self, pose: object) -> np.ndarray:  # noqa: ARG002
            self.calls += 1
            return np.full((96, 96, 3), 255 * (self.calls % 2), np.uint8)

    velocity, exposure_s = ALONG_X, 0.05
    while renderings(velocity, exposure_s, INTRINSICS, 1.0) % 2:
        exposure_s += 0.001
    image = expose(Flicker(), DOWN, velocity, exposure_s, INTRINSICS, 1.0)
    assert np.unique(image).tolist() == [188]


def test_every_value_is_given_back_where_nothing_changes_while_it_moves() -> None:
    ramp = np.arange(96 * 96 * 3, dtype=np.uint32).reshape(96, 96, 3).astype(np.uint8)

    class Constant(Camera):
        def __init__(self) -> None:
            """Nothing to render."""

        def render(self, pose: object) -> np.ndarray:  # noqa: ARG002
            return ramp

    assert (expose(Constant(), DOWN, ALONG_X, 0.05, INTRINSICS, 1.0) == ramp).all()


def keyframe(exposure_s: float, velocity: Floats, sequence: int = 0) -> Keyframe:
    mission = Mission(
        camera=CameraSettings(width_px=96, height_px=96),
        simulation=Simulation(exposure_s=exposure_s, image_noise=0.0),
        drones=(Drone(id=1, start=(0, 0, 2, 0, 1.3)),),
    )
    return Photographer(mission, CAMERA).take(Shot(Sight(1, 0, DOWN, DOWN, velocity=velocity), sequence))


def test_keyframes_are_blurred_by_the_true_velocity_the_same_every_time_and_posed_in_the_middle() -> None:
    blurred, sharp = keyframe(EXPOSURE_S, ALONG_X), keyframe(0.0, ALONG_X)
    assert blurred == keyframe(EXPOSURE_S, ALONG_X)
    assert keyframe(EXPOSURE_S, STILL) == keyframe(0.0, STILL) == sharp
    assert (blurred.position, blurred.rotation) == (sharp.position, sharp.rotation)
    one, other = (np.asarray(Image.open(io.BytesIO(k.jpeg)), float) for k in (blurred, sharp))
    assert contrast(one, 0) < 0.7 * contrast(other, 0)
    # Shifted by a pixel either way it fits worse than in place: the blur is symmetric about the pose.
    inner = one[2:-2, 2:-2]
    gaps = [float(((inner - other[2 + shift : 94 + shift, 2:-2]) ** 2).mean()) for shift in (-1, 0, 1)]
    assert gaps[1] < gaps[0]
    assert gaps[1] < gaps[2]


def test_what_is_due_carries_the_velocities_that_are_told() -> None:
    mission = Mission(drones=(Drone(id=1, start=(0, 0, 2, 0, 1.3)), Drone(id=2, start=(2, 0, 2, 0, 1.3))))
    shots = Photographer(mission, CAMERA).due(0, {1: DOWN, 2: DOWN}, {2: ALONG_X})
    assert [shot.sight.velocity.tolist() for shot in shots] == [STILL.tolist(), ALONG_X.tolist()]
