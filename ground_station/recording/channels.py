"""The one table of a recording's channels: what each kind of entry is written to, and how. The recorder's thread only.

Names are topics in Foxglove's sense; ``{drone}`` stands for a drone's id.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache
from typing import Any, Final, Literal, TypeAlias

import foxglove
from foxglove import messages as players
from pydantic import BaseModel
from pydantic_core import to_json

from ground_station.recording import shapes
from ground_station.recording.file import ChunkWriter
from ground_station.recording.stored import (
    IMAGES,
    StoredHandOver,
    StoredJump,
    StoredKeyframe,
    StoredLook,
    StoredMission,
    StoredTick,
    schema_of,
)
from ground_station.results import Metrics
from protocol import messages
from protocol.field import VirtualField
from protocol.mission import Mission

Kind: TypeAlias = Literal[
    "mission", "state", "depth", "keyframe", "event", "phase", "status", "hand_over", "look", "integrated", "jump",
    "phi", "mesh", "free", "metrics", "summary",
]  # fmt: skip

MISSION: Final = "/mission"
STATE: Final = "/drone/{drone}/state"
CAMERA: Final = "/drone/{drone}/camera"
DEPTH: Final = "/drone/{drone}/depth"
KEYFRAME: Final = "/drone/{drone}/keyframe"
EVENT: Final = "/event"
HAND_OVER: Final = "/ground/hand_over"
LOOK: Final = "/ground/look"
INTEGRATED: Final = "/ground/integrated"
JUMP: Final = "/phi/jump"
MESH: Final = "/map"
FREE: Final = "/map/free"
METRICS: Final = "/ground/metrics"
SUMMARY: Final = "/ground/summary"
_TRANSFORMS: Final = "/tf"
_POSE: Final = "/drone/{drone}/pose"
_CALIBRATION: Final = "/drone/{drone}/calibration"
_LOG: Final = "/log"
PHI: Final = "/phi"
_PHASE: Final = "/ground/phase"
_STATUS: Final = "/ground/status"

CHANNELS: Final[Mapping[Kind, tuple[str, ...]]] = {
    "mission": (MISSION,),
    "state": (_TRANSFORMS, _POSE, STATE),
    "depth": (DEPTH,),
    "keyframe": (_CALIBRATION, CAMERA, KEYFRAME),
    "event": (_LOG, EVENT),
    "phase": (_PHASE,),
    "status": (_STATUS,),
    "hand_over": (HAND_OVER,),
    "look": (LOOK,),
    "integrated": (INTEGRATED,),
    "jump": (JUMP,),
    "phi": (PHI,),
    "mesh": (MESH,),
    "free": (FREE,),
    "metrics": (METRICS,),
    "summary": (SUMMARY,),
}
"""A camera's image and its depth, if it has any, come right before their keyframe; the reader joins them."""

_FOR_PLAYERS: Final[Mapping[str, Any]] = {
    _TRANSFORMS: players.FrameTransforms,
    _POSE: players.PoseInFrame,
    _CALIBRATION: players.CameraCalibration,
    CAMERA: players.CompressedImage,
    DEPTH: players.CompressedImage,
    _LOG: players.Log,
    PHI: players.PointCloud,
    MESH: players.SceneUpdate,
    FREE: players.PointCloud,
}
_SCHEMAS: Final[Mapping[str, tuple[str, type]]] = {
    MISSION: ("Mission", StoredMission),
    STATE: ("DroneState", messages.DroneState),
    KEYFRAME: ("Keyframe", StoredKeyframe),
    EVENT: ("Event", messages.Event),
    _PHASE: ("Phase", messages.MissionPhase),
    _STATUS: ("Status", messages.Status),
    HAND_OVER: ("HandOver", StoredHandOver),
    LOOK: ("Look", StoredLook),
    INTEGRATED: ("Integrated", StoredTick),
    JUMP: ("Jump", StoredJump),
    METRICS: ("Metrics", Metrics),
    SUMMARY: ("Summary", dict[str, Any]),
}
"""Of JSON channels: the schema's name, after ``covrecon.``, and what it describes."""


@cache
def channels_of(kind: Kind, drone: int) -> tuple[str, ...]:
    """Topics of an entry; ``drone`` is ignored by kinds that belong to no drone."""
    return tuple(name.format(drone=drone) for name in CHANNELS[kind])


@dataclass(frozen=True, slots=True)
class _Channel:
    number: int
    """In the file."""
    live: foxglove.Channel | None
    """At the server."""


class Channels:
    """Writes entries to a file, to whoever listens at a server's context, or both."""

    def __init__(self, mission: Mission, mcap: ChunkWriter | None, context: foxglove.Context | None) -> None:
        """Raises OSError."""
        self._mcap, self._context = mcap, context  # without its context, a channel is closed
        self._positions = VirtualField.of(mission.target).positions()
        self._schemas: dict[str, int] = {}
        self._channels = {
            name.format(drone=drone): self._open(name, drone)
            for names in CHANNELS.values()
            for name in names
            for drone in ([drone.id for drone in mission.drones] if "{drone}" in name else [0])
        }

    def _open(self, name: str, drone: int) -> _Channel:
        topic = name.format(drone=drone)
        if name in _FOR_PLAYERS:
            schema, encoding = _FOR_PLAYERS[name].get_schema(), "protobuf"
        else:
            title, described = _SCHEMAS[name]
            data = json.dumps(schema_of(described)).encode()
            schema, encoding = foxglove.Schema(name=f"covrecon.{title}", encoding="jsonschema", data=data), "json"
        number = 0
        if self._mcap is not None:
            if schema.name not in self._schemas:
                self._schemas[schema.name] = self._mcap.register_schema(schema.name, schema.encoding, schema.data)
            number = self._mcap.register_channel(topic, encoding, self._schemas[schema.name])
        if self._context is None:
            return _Channel(number, None)
        return _Channel(
            number, foxglove.Channel(topic, schema=schema, message_encoding=encoding, context=self._context)
        )

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._channels)

    def write(self, kind: Kind, content: Any, time_ns: int) -> None:
        """``content`` is what `ground_station.recording.recorder.Recorder` takes for this kind.

        Raises:
            KeyError: of a drone that is not in the mission.
            OSError: the disk refuses it.
        """
        match kind:
            case "state":
                self._show(_TRANSFORMS, shapes.transforms(content, time_ns), time_ns)
                self._show(_POSE, shapes.pose(content, time_ns), time_ns, content.drone)
                self._store(STATE, content, time_ns, content.drone)
            case "depth":
                self._show(DEPTH, shapes.depth(content, time_ns), time_ns, content.drone)
            case "keyframe":
                self._show(_CALIBRATION, shapes.calibration(content, time_ns), time_ns, content.drone)
                self._show(CAMERA, shapes.image(content, time_ns), time_ns, content.drone)
                self._log(KEYFRAME, content.model_dump_json(exclude=IMAGES).encode(), time_ns, content.drone)
            case "event":
                self._show(_LOG, shapes.log_line(content, time_ns), time_ns)
                self._store(EVENT, content, time_ns)
            case "hand_over":
                names = tuple((keyframe.drone, keyframe.sequence) for keyframe in content.keyframes)
                self._store(HAND_OVER, StoredHandOver(tick=content.tick, keyframes=names), time_ns)
            case "look":
                self._store(LOOK, StoredLook(tick=content.tick, importance=content.importance), time_ns)
            case "integrated":
                poses = tuple(map(tuple, content.poses.tolist()))
                self._store(INTEGRATED, StoredTick(tick=content.tick, ids=content.ids, poses=poses), time_ns)
            case "jump":
                self._store(JUMP, StoredJump.of(content.look, content.jump), time_ns)
            case "phi":
                self._show(PHI, shapes.cloud(self._positions, content, time_ns), time_ns)
            case "mesh":
                self._show(MESH, shapes.scene(content, time_ns), time_ns)
            case "free":
                grid, free = content
                self._show(FREE, shapes.free_surface(grid, free, time_ns), time_ns)
            case "metrics":
                self._log(METRICS, to_json(asdict(content), inf_nan_mode="null"), time_ns)
            case "summary":
                self._log(SUMMARY, to_json(content.as_json()), time_ns)
            case "mission" | "phase" | "status":
                self._store(CHANNELS[kind][0], content, time_ns)

    def _show(self, name: str, content: Any, time_ns: int, drone: int = 0) -> None:
        """``content``: one of Foxglove's messages."""
        self._log(name, content.encode(), time_ns, drone)

    def _store(self, name: str, content: BaseModel, time_ns: int, drone: int = 0) -> None:
        self._log(name, content.model_dump_json().encode(), time_ns, drone)

    def _log(self, name: str, content: bytes, time_ns: int, drone: int = 0) -> None:
        channel = self._channels[name.format(drone=drone)]
        if self._mcap is not None:
            self._mcap.add_message(channel.number, time_ns, content, time_ns)
        if channel.live is not None:
            channel.live.log(content, log_time=time_ns)
