"""What a mission's map will take of the memory, known before it flies: so none dies of it halfway."""

from __future__ import annotations

from collections.abc import Mapping

from ground_station.reconstruction import depth_reconstructor, plane_sweep_reconstructor
from ground_station.reconstruction.fusion import BYTES_PER_VOXEL, Volume
from ground_station.reconstruction.plane_sweep_reconstructor import make_refiner
from protocol.errors import ReconstructionError
from protocol.mission import Mission

MEGABYTE = 10**6
EXTRACTION_BYTES = 2
"""A voxel, while a mesh is extracted (`surface_nets`)."""
SWEEP_BYTES = 5
"""A pixel and plane, of each thread that computes depth (`plane_sweep`, `semi_global`)."""


def needs(mission: Mission) -> Mapping[str, int]:
    """Bytes by what takes them, once all that is kept is there; empty where it is another program's or a network's."""
    settings = mission.reconstruction
    if settings.backend not in ("plane_sweep", "depth"):
        return {}
    shape = Volume.voxels(mission.target, settings.voxel_m, settings.truncation_m)
    voxels = shape[0] * shape[1] * shape[2]
    sweep = mission.sweep_intrinsics()
    pixels, size = sweep.width * sweep.height, f"{sweep.width} x {sweep.height}"
    found = {
        f"the volume of {shape[0]} x {shape[1]} x {shape[2]} voxels (voxel_m, target)": BYTES_PER_VOXEL * voxels,
        "extracting its mesh": EXTRACTION_BYTES * voxels,
    }
    kept = depth_reconstructor if settings.backend == "depth" else plane_sweep_reconstructor
    found[f"{kept.VIEWS_KEPT} keyframes of {size} (sweep_width_px)"] = kept.VIEWS_KEPT * kept.BYTES_PER_PIXEL * pixels
    if settings.backend == "plane_sweep":
        found[f"{settings.workers} depth threads (workers, depth_planes)"] = (
            SWEEP_BYTES * pixels * settings.depth_planes * settings.workers
        )
        refiner = make_refiner(mission)
        if refiner is not None:
            found["what poses are mended by (refine_poses)"] = refiner.size_bytes
    return found


def check_memory(mission: Mission) -> None:
    """Raises `ReconstructionError`, naming what takes it, if the map would need more than the mission allows."""
    limit_mb, parts = mission.reconstruction.memory_limit_mb, needs(mission)
    if sum(parts.values()) <= limit_mb * MEGABYTE:
        return
    listed = ", ".join(
        f"{size / MEGABYTE:.0f} MB {name}" for name, size in sorted(parts.items(), key=lambda part: -part[1])
    )
    raise ReconstructionError(
        f"the map would take {sum(parts.values()) / MEGABYTE:.0f} MB, more than reconstruction.memory_limit_mb "
        f"{limit_mb:g}: {listed}"
    )
