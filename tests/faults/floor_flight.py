"""The keyframes of a drone that looks straight down on a randomly patterned floor and moves sideways, and its run."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image

from ground_station.keyframe_log import KEYFRAMES_FILE, KeyframeLog
from ground_station.results import MISSION_FILE
from protocol.geometry import Intrinsics, camera_rotation
from protocol.map_settings import Camera, Feedback, Reconstruction
from protocol.messages import Keyframe
from protocol.mission import Drone, Mission, Target

MISSION = Mission(
    target=Target(lower_m=(-1, -1, 0), upper_m=(1, 1, 0.4)),
    camera=Camera(width_px=160, height_px=90),
    reconstruction=Reconstruction(sweep_width_px=96, depth_planes=32, nearest_m=0.6, farthest_m=2.5, workers=1),
    feedback=Feedback(spacing_m=0.2),
    drones=(Drone(id=1, start=(0, 0, 2, 0, 1.4)),),
)
HEIGHT_M, STEP_M, PATCH_PX = 1.4, 0.13, 4
LEG = 14


def fly() -> list[Keyframe]:
    camera = MISSION.camera.intrinsics()
    rotation = camera_rotation(0.0, np.pi / 2)
    step_px = round(STEP_M * camera.fx / HEIGHT_M)
    width = camera.width + LEG * step_px
    patches = np.random.default_rng(0).integers(0, 255, (camera.height // PATCH_PX + 1, width // PATCH_PX + 1, 3))
    floor = patches.repeat(PATCH_PX, axis=0).repeat(PATCH_PX, axis=1).astype(np.uint8)
    keyframes = []
    for number in range(LEG):
        view = floor[: camera.height, number * step_px : number * step_px + camera.width]
        place = np.array([0.0, 0.0, HEIGHT_M]) + rotation[:, 0] * step_px * HEIGHT_M / camera.fx * (number - LEG / 2)
        image = np.ascontiguousarray(view)
        keyframes.append(message(number, image, place.tolist(), rotation.tolist(), camera))
    return keyframes


def message(
    number: int,
    image: NDArray[np.uint8],
    place: Sequence[float],
    rows: Sequence[Sequence[float]],
    camera: Intrinsics,
) -> Keyframe:
    jpeg = io.BytesIO()
    Image.fromarray(image).save(jpeg, "JPEG", quality=95)
    return Keyframe.model_validate(
        {
            "drone": 1,
            "sequence": number,
            "tick": 10 * number,
            "position": tuple(place),
            "rotation": tuple(map(tuple, rows)),
            "width": camera.width,
            "height": camera.height,
            **{name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")},
            "jpeg": jpeg.getvalue(),
        }
    )


def write_run(folder: Path) -> None:
    """What the flight leaves: mission, keyframes, and the floor's truth."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / MISSION_FILE).write_text(MISSION.model_dump_json())
    with KeyframeLog(folder / KEYFRAMES_FILE) as log:
        for keyframe in fly():
            log.append(keyframe)
    points = np.random.default_rng(0).uniform((-1, -1, 0), (1, 1, 0), (20_000, 3)).astype(np.float32)
    seen = np.ones(len(points), bool)
    np.savez(folder / "truth_samples.npz", points=points, exposed=seen, visible=seen)
    corners, halves = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], [(0, 1, 2), (0, 2, 3)]
    trimesh.Trimesh(corners, halves, process=False).export(folder / "truth.ply")
