"""Where drones take their poses from: ``[localization]``, ``[lidar]`` and ``[mocap]`` of a mission file."""

from __future__ import annotations

import math
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from protocol.settings import Angle, NonNegative, Positive, Settings


class Localization(Settings):
    """Where poses come from, and what is done with bad ones (docs/localization.md)."""

    source: Literal["vehicle", "lidar", "mocap"] = "vehicle"
    """The vehicle's own estimate, motion capture or GNSS behind it; or KISS-ICP on a lidar's scans (extra ``lidar``),
    or what motion capture or another eye outside sees of it (``[mocap]``), both fused with the vehicle's velocity."""
    deviation_max_m: Positive = 0.2
    """A drone whose position has a larger standard deviation holds ..."""
    lost_s: Positive = 5.0
    """... and lands, when that lasts so long."""
    keyframe_deviation_max_m: Positive = 0.1
    """Keyframes with a larger one are left out of the map, ..."""
    keyframe_deviation_max_rad: Positive = math.radians(5)
    """... and those whose angles have a larger one than this."""
    start_deviation_m: Positive = 0.01
    """Standard deviation of the place where a drone knows itself at first, unless its vehicle tells a larger one."""
    velocity_error_mps: Positive = 0.05
    """Of the vehicle's velocity, each axis: what "lidar" and "mocap" expect of its slow error. Optical flow's."""


class Lidar(Settings):
    """The sensor of ``localization.source`` "lidar": a non-repetitive one, whose rays go elsewhere in every scan; rings
    that repeat drag the estimate along (docs/localization.md). It hangs upside down, as a Livox Mid-360 would."""

    rays: Annotated[int, Field(ge=100, le=20_000)] = 4000
    """In each scan."""
    rate_hz: Positive = 10.0
    range_min_m: Positive = 0.1
    range_max_m: Annotated[float, Field(gt=0, le=32)] = 20.0
    """Ranges travel in millimetres, as int16."""
    range_noise_m: NonNegative = 0.01
    """Standard deviation."""
    elevation_rad: tuple[Angle, Angle] = (math.radians(-52), math.radians(7))
    """Of its rays, above the horizon of the airframe; all around."""
    voxel_m: Annotated[float, Field(ge=0.05, le=2)] = 0.2
    """Edge of the map's voxels. At 0.1 the error is a third smaller and a scan takes three times as long."""

    @model_validator(mode="after")
    def _ranges_ascend(self) -> Self:
        low, high = self.elevation_rad
        if not -math.pi / 2 <= low < high <= math.pi / 2:
            raise ValueError(f"elevation_rad must ascend within [-pi/2, pi/2], got [{low}, {high}]")
        if high < 0:
            raise ValueError("elevation_rad must reach the horizon: who sees the floor alone is lost by metres")
        if self.range_min_m >= self.range_max_m:
            raise ValueError("range_min_m must be less than range_max_m")
        return self


class EstimateNoise(Settings):
    """What the simulated vehicles' estimates of themselves are off by; all zero: they know where they are."""

    drift_m: NonNegative = 0.0
    """Standard deviation of the slow error of each coordinate, once it has had time to grow from none."""
    drift_rad: NonNegative = 0.0
    """Likewise of the yaw."""
    velocity_mps: NonNegative = 0.0
    """Likewise of the velocity, each axis."""
    drift_s: Positive = 60.0
    """How long slow errors stay alike."""
    white_m: NonNegative = 0.0
    """Standard deviation of each coordinate's error that is new in every tick ..."""
    white_rad: NonNegative = 0.0
    """... and of yaw and pitch."""

    @property
    def is_silent(self) -> bool:
        return not any((self.drift_m, self.drift_rad, self.velocity_mps, self.white_m, self.white_rad))


class Mocap(Settings):
    """What ``localization.source`` "mocap" expects of motion capture, and where to find it (docs/localization.md)."""

    system: Literal["optitrack", "qualisys", "vicon", "vrpn", "mock"] = "vrpn"
    """Whose poses ``covrecon mocap`` passes on (extra ``mocap``); mock: bodies that stand where their drones start."""
    host: str = "127.0.0.1"
    """The computer that runs its software."""
    rate_hz: Positive = 50.0
    """Poses of each drone, a second, at most; a simulated capture sends no more than one a tick."""
    deviation_m: Positive = 0.002
    """Standard deviation of each coordinate of a pose that tells none; no fused position is better ..."""
    deviation_rad: Positive = 0.01
    """... and of its yaw, likewise."""
    latency_s: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    """How old a pose is when it is passed on: cameras, software and the way to us. Of a simulated capture too."""
    reacquire_s: Positive = 0.5
    """A drone whose position has become unsure believes poses again that agree for so long with each other and with
    its velocity."""


class CaptureNoise(Settings):
    """What is wrong with a simulated capture: ``[simulation.mocap]``."""

    noise_m: NonNegative = 0.001
    """Standard deviation of each coordinate ..."""
    noise_rad: NonNegative = 0.003
    """... and of the yaw."""
    dropouts_per_min: NonNegative = 0.0
    """How often, in the mean, a body is lost from view ..."""
    dropout_s: Positive = 1.0
    """... for so long."""
