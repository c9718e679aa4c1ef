"""Our messages in Foxglove's shapes, which its players draw: frames, cameras, the map and phi.

Frames: ``world``; ``drone_N``, at the vehicle, turned by the camera's yaw; ``camera_N``, the optical frame. All are
computed from a pose as `protocol.geometry` defines it.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from foxglove.messages import (
    CameraCalibration,
    CompressedImage,
    FrameTransform,
    FrameTransforms,
    Log,
    LogLevel,
    ModelPrimitive,
    PackedElementField,
    PackedElementFieldNumericType,
    PointCloud,
    Pose,
    PoseInFrame,
    Quaternion,
    SceneEntity,
    SceneUpdate,
    Timestamp,
    Vector3,
)
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from ground_station.mesh_files import glb
from ground_station.reconstruction.reconstructor import Mesh
from protocol import messages
from protocol.geometry import Floats
from protocol.obstacle_grid import Cells, ObstacleGrid

WORLD: Final = "world"
GLB_TYPE: Final = "model/gltf-binary"
LEVELS: Final = {"info": LogLevel.Info, "warning": LogLevel.Warning, "error": LogLevel.Error}
NANOSECONDS: Final = 1_000_000_000

_RAMP = np.array([[13, 8, 135], [204, 71, 120], [240, 249, 33]])
"""Colours of the least, the middle and the largest importance: those of matplotlib's plasma."""
POINT = np.dtype([("position", "<f4", 3), ("colour", "u1", 4), ("importance", "<f4")])
_POINT_FIELDS = [
    *(PackedElementField(name=name, offset=4 * i, type=PackedElementFieldNumericType.Float32)
      for i, name in enumerate("xyz")),
    *(PackedElementField(name=name, offset=12 + i, type=PackedElementFieldNumericType.Uint8)
      for i, name in enumerate(("red", "green", "blue", "alpha"))),
    PackedElementField(name="importance", offset=16, type=PackedElementFieldNumericType.Float32),
]  # fmt: skip
_PLACE = np.dtype(("<f4", 3))
_QUARTER_TURN_BACK = Quaternion(x=0.0, y=0.0, z=-math.sqrt(0.5), w=math.sqrt(0.5))
"""Players turn a glTF model, whose y is up, so that its z comes to lie along the world's x; `glb` means -y."""


def stamp(time_ns: int) -> Timestamp:
    return Timestamp(*divmod(time_ns, NANOSECONDS))


def yaw_quaternion(yaw_rad: float) -> Quaternion:
    """The turn about the world's z."""
    return Quaternion(x=0.0, y=0.0, z=math.sin(yaw_rad / 2), w=math.cos(yaw_rad / 2))


def camera_quaternion(pitch_rad: float) -> Quaternion:
    """From the optical frame (right, down, forward) to the frame that only turns with the yaw."""
    sine, cosine = math.sin(pitch_rad / 2), math.cos(pitch_rad / 2)
    return Quaternion(x=-(cosine + sine) / 2, y=(cosine + sine) / 2, z=-(cosine - sine) / 2, w=(cosine - sine) / 2)


def transforms(state: messages.DroneState, time_ns: int) -> FrameTransforms:
    x, y, z, yaw, pitch = state.pose
    body, camera = f"drone_{state.drone}", f"camera_{state.drone}"
    at = stamp(time_ns)
    return FrameTransforms(
        transforms=[
            FrameTransform(
                timestamp=at,
                parent_frame_id=WORLD,
                child_frame_id=body,
                translation=Vector3(x=x, y=y, z=z),
                rotation=yaw_quaternion(yaw),
            ),
            FrameTransform(
                timestamp=at,
                parent_frame_id=body,
                child_frame_id=camera,
                translation=Vector3(x=0.0, y=0.0, z=0.0),
                rotation=camera_quaternion(pitch),
            ),
        ]
    )


def pose(state: messages.DroneState, time_ns: int) -> PoseInFrame:
    x, y, z, yaw, _ = state.pose
    return PoseInFrame(
        timestamp=stamp(time_ns),
        frame_id=WORLD,
        pose=Pose(position=Vector3(x=x, y=y, z=z), orientation=yaw_quaternion(yaw)),
    )


def image(keyframe: messages.Keyframe, time_ns: int) -> CompressedImage:
    return CompressedImage(
        timestamp=stamp(time_ns), frame_id=f"camera_{keyframe.drone}", data=keyframe.jpeg, format="jpeg"
    )


def depth(keyframe: messages.Keyframe, time_ns: int) -> CompressedImage:
    return CompressedImage(
        timestamp=stamp(time_ns), frame_id=f"camera_{keyframe.drone}", data=keyframe.depth, format="png"
    )


def calibration(keyframe: messages.Keyframe, time_ns: int) -> CameraCalibration:
    fx, fy, cx, cy = keyframe.fx, keyframe.fy, keyframe.cx, keyframe.cy
    return CameraCalibration(
        timestamp=stamp(time_ns),
        frame_id=f"camera_{keyframe.drone}",
        width=keyframe.width,
        height=keyframe.height,
        K=[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        P=[fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    )


def log_line(event: messages.Event, time_ns: int) -> Log:
    return Log(
        timestamp=stamp(time_ns), level=LEVELS[event.level], name=event.source, message=f"{event.kind}: {event.text}"
    )


def cloud(positions: Floats, importance: NDArray[np.float32], time_ns: int) -> PointCloud:
    """``positions`` (n, 3) m, world, each coloured by its ``importance`` (n,) in 0..1."""
    points = np.empty(len(positions), POINT)
    points["position"] = positions
    points["importance"] = importance
    levels = np.linspace(0, 1, len(_RAMP))
    for channel in range(3):
        points["colour"][:, channel] = np.interp(importance, levels, _RAMP[:, channel])
    points["colour"][:, 3] = 255
    return PointCloud(
        timestamp=stamp(time_ns),
        frame_id=WORLD,
        point_stride=POINT.itemsize,
        fields=_POINT_FIELDS,
        data=points.tobytes(),
    )


def free_surface(grid: ObstacleGrid, free: Cells, time_ns: int) -> PointCloud:
    """Where free space ends: the middles of cells that are not free beside one that is. Above the lattice all is free;
    what lies beside and below it is not judged."""
    padded = np.pad(free, 1)
    padded[:, :, -1] = True
    beside = binary_dilation(padded)[1:-1, 1:-1, 1:-1]
    places = grid.origin + grid.cell_m * (np.argwhere(beside & ~free) + 0.5)
    return PointCloud(
        timestamp=stamp(time_ns),
        frame_id=WORLD,
        point_stride=_PLACE.itemsize,
        fields=_POINT_FIELDS[:3],
        data=places.astype(_PLACE.base).tobytes(),
    )


def scene(mesh: Mesh, time_ns: int) -> SceneUpdate:
    """The map, in place of the one before."""
    model = ModelPrimitive(
        pose=Pose(position=Vector3(x=0.0, y=0.0, z=0.0), orientation=_QUARTER_TURN_BACK),
        scale=Vector3(x=1.0, y=1.0, z=1.0),
        media_type=GLB_TYPE,
        data=glb(mesh.vertices, mesh.faces, mesh.colors),
    )
    return SceneUpdate(entities=[SceneEntity(timestamp=stamp(time_ns), frame_id=WORLD, id="map", models=[model])])
