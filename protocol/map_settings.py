"""The map's part of a mission: cameras, what makes a mesh of their images, and what its changes do to φ."""

from __future__ import annotations

import math
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from protocol.geometry import Intrinsics
from protocol.settings import NonNegative, Positive, Settings


class Cylinder(Settings):
    """Around a core point along the surface's normal: where M3C2 compares two meshes, eq. (6). The paper states no
    sizes; ours are in docs/adr/0014."""

    radius_m: Positive = 0.05
    """Two voxels: a plane has a dozen vertices in it."""
    half_length_m: Positive = 0.25
    """Largest displacement that can be measured; what appeared or vanished counts as much. An odd multiple of radius_m:
    the reference implementation, py4dgeo, cuts the cylinder into so many slabs and loses points between two of them,
    where with an even number the core point's own plane lies."""
    points_min: Annotated[int, Field(ge=1)] = 1
    """Vertices in it from which a mesh has a surface there; 1 as in py4dgeo."""

    @model_validator(mode="after")
    def _has_an_odd_number_of_slabs(self) -> Self:
        slabs = self.half_length_m / self.radius_m
        if round(slabs) % 2 == 0 or not math.isclose(slabs, round(slabs), rel_tol=1e-6):
            raise ValueError(
                f"half_length_m {self.half_length_m:g} must be an odd multiple of radius_m {self.radius_m:g}"
            )
        return self


class Feedback(Settings):
    """Jumps of the importance where the mesh still changes, eqs. (4) to (6)."""

    method: Literal["grid", "m3c2", "none"] = "grid"
    """What changes: the number of vertices near a point, eq. (5); or how far the surface has moved, eq. (6)."""
    gain: NonNegative = 1.0
    """delta_2'."""
    threshold: Annotated[float, Field(ge=0, le=1)] = 0.5
    """J_th: no jumps while J is at or above it."""
    period_s: Positive = 2.0
    """Time between two meshes that are compared."""
    delay_s: NonNegative = 1.0
    """Age at which a jump takes effect, the same in every process: time to compute and to travel; at most a period."""
    kappa: Positive = 4.0
    """Change in the number of vertices around a point that counts, eq. (5); for "grid" alone. A plane has
    (spacing_m / voxel_m)^2 = 16 there, of which one to three come and go with every view. At the printed 0.7, for a
    grid and a density that are not stated, one counts as much as new surface, and J does not settle (docs/adr/0017)."""
    cylinder: Cylinder = Cylinder()
    """For "m3c2" alone."""
    kernel_m: Positive = 0.4
    """sigma_4."""
    spacing_m: Positive = 0.1
    """Spacing of the evaluation points r_k; not stated in the paper (departure 6). At 0.3 m every point holds
    some vertex that moved, and J hangs at its threshold; at 0.1 m jumps shrink as the map settles (docs/adr/0003)."""
    normalisation: Literal["sum", "mean"] = "mean"
    """"sum" as printed; "mean" divides by the kernel's weight, with "m3c2" by that on a plane and by the largest
    displacement, so that one jump never exceeds the gain."""

    @model_validator(mode="after")
    def _jumps_before_the_next_mesh(self) -> Self:
        if self.delay_s > self.period_s:
            raise ValueError(f"delay_s {self.delay_s:g} must not exceed period_s {self.period_s:g}")
        return self


class Camera(Settings):
    width_px: Annotated[int, Field(ge=32, le=4096)] = 320
    height_px: Annotated[int, Field(ge=32, le=4096)] = 180
    horizontal_fov_rad: Annotated[float, Field(gt=0.1, lt=2.8)] = 2 * math.atan(36 / 2 / 24)
    """24 mm equivalent (paper): 73.7 degrees."""
    keyframe_baseline_m: Positive = 0.12
    """A keyframe is taken when the camera moved so far since the last ..."""
    keyframe_angle_rad: Annotated[float, Field(gt=0, le=math.pi)] = math.radians(15)
    """... or turned so far."""
    jpeg_quality: Annotated[int, Field(ge=30, le=100)] = 90
    latency_s: NonNegative = 0.0
    """Of a real camera: from exposure until its frame is read here; images are posed at arrival less this."""
    depth: bool = False
    """Whether it measures depth as well, which its keyframes then carry; with reconstruction.backend "depth" it always
    does. For now, only simulated cameras can."""

    def intrinsics(self) -> Intrinsics:
        return Intrinsics.from_field_of_view(self.width_px, self.height_px, self.horizontal_fov_rad)


class Learned(Settings):
    """For the backend "learned" alone."""

    weights: str = ""
    """Path of a safetensors file that `covrecon train` wrote, relative to the mission file; empty: those that come with
    this release."""


class Reconstruction(Settings):
    """Images to mesh; docs/adr/0004 has the measurements behind it."""

    backend: Literal["plane_sweep", "depth", "learned", "external", "none"] = "plane_sweep"
    """"plane_sweep": depth from images; "depth": that of depth cameras; "learned": a network's, which takes the extra
    of that name and has voxels of its own, 4 cm (docs/learned.md); "external": a process of your own makes the map
    (docs/external-reconstructor.md)."""
    sweep_width_px: Annotated[int, Field(ge=32, le=1024)] = 128
    """Width at which depth is computed, or measured by a depth camera; the height follows from the camera."""
    depth_planes: Annotated[int, Field(ge=8, le=256)] = 48
    nearest_m: Positive = 0.35
    farthest_m: Positive = 4.2
    sources: Annotated[int, Field(ge=1, le=8)] = 4
    """Other keyframes that one keyframe is compared with."""
    voxel_m: Positive = 0.025
    truncation_m: Positive = 0.05
    refine_poses: bool = False
    """Whether keyframes' poses are mended by what their images show, and refused where they cannot be."""
    pose_sigma_m: Positive = 0.02
    """Standard deviation, on each axis, of the position that comes with a keyframe ..."""
    pose_sigma_rad: Positive = math.radians(0.5)
    """... and of its attitude; for ``refine_poses`` alone."""
    workers: Annotated[int, Field(ge=1, le=64)] = 2
    """Threads that compute depth maps; the mesh does not depend on it."""
    device: Literal["cpu", "cuda", "auto"] = "cpu"
    """Where "plane_sweep" computes depth: "cuda" on a graphics card, which takes torch; "auto" there if there is one.
    The two differ by rounding (docs/adr/0023)."""
    memory_limit_mb: Positive = 2048.0
    """That the map may take: a mission whose map needs more is refused, and one whose map grows beyond it is told. The
    paper's box takes 130 MB, at 1.5 cm 0.4 GB, at 1 cm 1.1 GB. A volume above 8 GiB is refused whatever stands here."""
    external_patience_s: Annotated[float, Field(gt=0, le=60)] = 20.0
    """Wall time that a flight in lockstep waits for an external process's map, at each update and at the end."""
    learned: Learned = Learned()
