"""Runs the map once over made-up images, so that numba compiles before the mission and not in its first seconds."""

from __future__ import annotations

import numpy as np

from ground_station.mesh_blocks import MeshBlocks
from ground_station.mesh_change_choice import make_mesh_change
from ground_station.reconstruction.backends import make_reconstructor
from ground_station.reconstruction.reconstructor import Keyframe
from protocol.field import VirtualField
from protocol.geometry import camera_rotation
from protocol.map_settings import Camera, Reconstruction
from protocol.mission import Mission, Target

HEIGHT_M = 1.2
"""Of the camera above the floor of the target."""
STEP_PX = 12
"""Between two images; 7 cm on the floor."""
IMAGES = 12
"""Enough for the first ones to be compared, confirmed and fused."""
TICKS_APART = 10
PATCH_PX = 8
DEPTH_PX = (36, 64)
DRIFT_M = 1e-4
"""By which each depth image differs from the one before: two alike would be a frozen camera's."""


def rehearse(mission: Mission) -> int:
    """Map a flat, randomly patterned floor seen from a camera that moves sideways; how many images were fused.

    Of ``mission`` it takes backend, device, refinement, weights and feedback alone: compiling does not depend on
    sizes. It takes half a second, or the better part of a minute on a machine that has not compiled yet. For a map that
    is made elsewhere, another one stands in, so that there is a mesh to compare.
    """
    asked = mission.reconstruction
    backend = "depth" if asked.backend == "external" else asked.backend
    settings = Reconstruction(
        backend=backend, refine_poses=asked.refine_poses, learned=asked.learned, device=asked.device
    )
    mission = mission.model_copy(update={"camera": Camera(), "target": Target(), "reconstruction": settings})
    intrinsics = mission.camera.intrinsics()
    lower, upper = np.array(mission.target.lower_m), np.array(mission.target.upper_m)
    rotation = camera_rotation(0.0, np.pi / 2)
    patches = np.random.default_rng(0).integers(
        0, 255, (intrinsics.height // PATCH_PX + 1, (intrinsics.width + IMAGES * STEP_PX) // PATCH_PX + 1, 3)
    )
    floor = patches.repeat(PATCH_PX, axis=0).repeat(PATCH_PX, axis=1).astype(np.uint8)
    centre = np.array([*(lower[:2] + upper[:2]) / 2, lower[2] + HEIGHT_M])
    step_m = STEP_PX * HEIGHT_M / intrinsics.fx
    reconstructor = make_reconstructor(mission)
    for k in range(IMAGES):
        column = k * STEP_PX
        reconstructor.add(
            [
                Keyframe(
                    drone=1,
                    sequence=k,
                    tick=k * TICKS_APART,
                    image=np.ascontiguousarray(floor[: intrinsics.height, column : column + intrinsics.width]),
                    position=centre + rotation[:, 0] * step_m * (k - IMAGES / 2),
                    rotation=rotation,
                    intrinsics=intrinsics,
                    depth=np.full(DEPTH_PX, HEIGHT_M + k * DRIFT_M, np.float32),
                )
            ]
        )
    reconstructor.flush()
    mesh = reconstructor.mesh()
    MeshBlocks().update(mesh)
    make_mesh_change(mission, VirtualField.of(mission.target)).update(mesh)
    return reconstructor.statistics().fused
