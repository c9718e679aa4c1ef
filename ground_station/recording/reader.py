"""Reads a recording back: the inputs from which the flight can be made again, and what there is to show of it."""

from __future__ import annotations

import json
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
from google.protobuf.message import DecodeError  # type: ignore[import-untyped]  # ships no types
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap_protobuf.decoder import DecoderFactory
from numpy.typing import NDArray
from pydantic import ValidationError

from ground_station.recording import channels
from ground_station.recording.entries import HandOver, Input, IntegratedTick, JumpRecord, KeyframeName, Look
from ground_station.recording.mcap_file import DAMAGE, Salvage, is_mcap, is_whole
from ground_station.recording.shapes import POINT
from ground_station.recording.stored import (
    RECORDING_VERSION,
    StoredHandOver,
    StoredJump,
    StoredKeyframe,
    StoredLook,
    StoredMission,
    StoredTick,
)
from ground_station.recording.writer import LOSSES_METADATA, MESH_ATTACHMENT
from protocol import messages
from protocol.errors import RecordingError
from protocol.mission import Mission


@dataclass(frozen=True, slots=True)
class _Found:
    """One message of a file."""

    topic: str
    time_ns: int
    data: bytes
    schema: Schema | None


class Recording:
    """One file, read anew by each call; its iterators may be left before their end.

    What is read raises `RecordingError` where the file is damaged.
    """

    def __init__(self, path: Path, *, salvage: bool = False) -> None:
        """See `open`."""
        self.path = path
        self._salvage = Salvage(path) if salvage else None
        self._decoders: dict[str, Callable[[bytes], Any]] = {}
        begun = self._begun()
        self.resumed = begun.resumed
        """Whether phi and the map did not begin with this recording."""
        self.lossless = begun.lossless
        """Whether it was flown in lockstep."""
        self.epoch_ns = begun.epoch_ns
        """Unix time of tick 0."""
        self.mission = self._checked(begun)
        self._tick_ns = self.mission.tick_s * 1e9
        self._drones = {
            channel.format(drone=drone.id): drone.id
            for channel in (channels.CAMERA, channels.DEPTH, channels.KEYFRAME)
            for drone in self.mission.drones
        }

    @classmethod
    def open(cls, path: Path, *, salvage: bool = False) -> Self:
        """Open a file that was closed by its writer or by `ground_station.recording.repair`; with ``salvage``, any,
        of which the parts that are whole are read.

        Raises:
            RecordingError: it cannot be read, is no recording, is torn, or is of another version.
        """
        try:
            if not is_mcap(path):
                raise RecordingError(f"{path}: not an MCAP file")
            salvage = salvage and not is_whole(path)
            if not (salvage or is_whole(path)):
                raise RecordingError(f"{path}: cut short; 'covrecon recording repair {path}' recovers what is whole")
        except OSError as error:
            raise RecordingError(f"{path}: {error.strerror}") from error
        return cls(path, salvage=salvage)

    def _begun(self) -> StoredMission:
        with self._reading():
            for found in self._messages([channels.MISSION]):
                begun = json.loads(found.data)
                if begun.get("version") != RECORDING_VERSION:
                    raise RecordingError(
                        f"{self.path}: recording of version {begun.get('version')}, this program reads"
                        f" {RECORDING_VERSION}"
                    )
                return StoredMission.model_validate_json(found.data)
        raise RecordingError(f"{self.path}: holds no mission, so it is not a recording of this program's")

    def _checked(self, begun: StoredMission) -> Mission:
        try:
            return Mission.model_validate_json(json.dumps(begun.mission), strict=True)
        except ValidationError as error:
            first = error.errors(include_url=False, include_input=False)[0]
            place = ".".join(map(str, first["loc"]))
            raise RecordingError(f"{self.path}: mission is not this version's: {place}: {first['msg']}") from error

    # --- inputs --------------------------------------------------------------------------------------------------

    def inputs(self) -> Iterator[Input]:
        """What phi and the map were made from, in order."""
        waiting: defaultdict[KeyframeName, deque[messages.Keyframe]] = defaultdict(deque)
        wanted = [channels.HAND_OVER, channels.LOOK, channels.INTEGRATED, channels.JUMP, *self._drones]
        for found in self._joined(wanted):
            if isinstance(found, messages.Keyframe):
                waiting[found.drone, found.sequence].append(found)
                continue
            with self._reading():
                match found.topic:
                    case channels.HAND_OVER:
                        stored = StoredHandOver.model_validate_json(found.data)
                        entry: Input = _hand_over(stored, waiting)
                        for name in [name for name, kept in waiting.items() if not kept or kept[-1].tick < stored.tick]:
                            del waiting[name]  # for these there was no time
                    case channels.LOOK:
                        look = StoredLook.model_validate_json(found.data)
                        entry = Look(look.tick, look.importance)
                    case channels.INTEGRATED:
                        step = StoredTick.model_validate_json(found.data)
                        entry = IntegratedTick(step.tick, step.ids, np.array(step.poses, float).reshape(-1, 5))
                    case _:
                        jump = StoredJump.model_validate_json(found.data)
                        entry = JumpRecord(jump.look, jump.jump())
            yield entry

    def keyframes(self) -> Iterator[messages.Keyframe]:
        """All that were heard, as they came."""
        for found in self._joined(list(self._drones)):
            if isinstance(found, messages.Keyframe):
                yield found

    def _joined(self, topics: Sequence[str]) -> Iterator[_Found | messages.Keyframe]:
        """Messages, but for keyframes and their images, which are put together."""
        images: dict[str, tuple[int, bytes]] = {}
        for found in self._messages(topics):
            drone = self._drones.get(found.topic)
            if drone is None:
                yield found
            elif found.topic != channels.KEYFRAME.format(drone=drone):
                images[found.topic] = found.time_ns, self._decoded(found).data
            else:
                time_ns, jpeg = images.pop(channels.CAMERA.format(drone=drone), (-1, b""))
                if time_ns != found.time_ns:
                    continue  # its image is in a chunk that is lost
                time_ns, depth = images.pop(channels.DEPTH.format(drone=drone), (-1, b""))
                with self._reading():
                    keyframe = StoredKeyframe.model_validate_json(found.data)
                    measured = depth if time_ns == found.time_ns else b""
                    joined = messages.Keyframe(**vars(keyframe), jpeg=jpeg, depth=measured)
                yield joined

    # --- what there is to show -----------------------------------------------------------------------------------

    @property
    def torn(self) -> bool:
        """Whether its writer did not come to its end, and not all of it can be read."""
        return self._salvage is not None

    @cached_property
    def complete(self) -> bool:
        """Whether the flight's end is in it."""
        return not self.torn and self.summary() is not None

    def states(self, drone: int) -> Iterator[messages.DroneState]:
        for found in self._messages([channels.STATE.format(drone=drone)]):
            with self._reading():
                state = messages.DroneState.model_validate_json(found.data)
            yield state

    def events(self) -> Iterator[messages.Event]:
        for found in self._messages([channels.EVENT]):
            with self._reading():
                event = messages.Event.model_validate_json(found.data)
            yield event

    def metrics(self) -> list[dict[str, Any]]:
        """Rows as `ground_station.results.Metrics`, tables in tables; null for what there is not."""
        return [self._json(found) for found in self._messages([channels.METRICS])]

    def summary(self) -> dict[str, Any] | None:
        """The content of summary.json; None if the flight's end is not in it."""
        rows = [self._json(found) for found in self._messages([channels.SUMMARY])]
        return rows[-1] if rows else None

    def meshes(self) -> Iterator[tuple[int, bytes]]:
        """Ticks and maps as GLB, whose y is up."""
        for found in self._messages([channels.MESH]):
            for entity in self._decoded(found).entities:
                for model in entity.models:
                    yield self.tick_of(found.time_ns), model.data

    def fields(self) -> Iterator[tuple[int, NDArray[np.float32], NDArray[np.float32]]]:
        """Ticks, positions (n, 3) m, and phi's mean over the directions of each, (n,)."""
        for found in self._messages([channels.PHI]):
            with self._reading():
                points = np.frombuffer(self._decoded(found).data, POINT)
            yield self.tick_of(found.time_ns), points["position"].copy(), points["importance"].copy()

    def final_mesh_ply(self) -> bytes | None:
        """The last map, world frame; None if the flight's end is not in the recording, or it made none."""
        with self._reading():
            return next((part.data for part in self._attachments() if part.name == MESH_ATTACHMENT), None)

    def counts(self) -> dict[str, int]:
        """Messages of each channel that has any."""
        with self._reading():
            if self._salvage is None:
                with self.path.open("rb") as file:
                    summary = make_reader(file).get_summary()
                if summary is not None and summary.statistics is not None:
                    names = {number: channel.topic for number, channel in summary.channels.items()}
                    counted = summary.statistics.channel_message_counts
                    return {names[number]: count for number, count in sorted(counted.items())}
        return dict(Counter(found.topic for found in self._messages(None)))

    def losses(self) -> dict[str, int]:
        """Messages of each channel that the recorder had to drop, of channels with any; known when it was closed."""
        with self._reading():
            noted = next((part.metadata for part in self._metadata() if part.name == LOSSES_METADATA), {})
            return {name: int(count) for name, count in noted.items()}

    def tick_of(self, time_ns: int) -> int:
        """Of a log time."""
        return round((time_ns - self.epoch_ns) / self._tick_ns)

    # --- the file ------------------------------------------------------------------------------------------------

    def _messages(self, topics: Sequence[str] | None) -> Iterator[_Found]:
        """In the order of the file; of all channels if ``topics`` is None."""
        with self._reading():
            if self._salvage is not None:
                yield from _salvaged(self._salvage, topics)
                return
            with self.path.open("rb") as file:
                reader = make_reader(file, validate_crcs=True)
                for schema, channel, message in reader.iter_messages(topics, log_time_order=False):
                    yield _Found(channel.topic, message.log_time, message.data, schema)

    def _attachments(self) -> Iterator[Attachment]:
        if self._salvage is not None:
            yield from (content for content in self._salvage.contents() if isinstance(content, Attachment))
            return
        with self.path.open("rb") as file:
            yield from make_reader(file).iter_attachments()

    def _metadata(self) -> Iterator[Metadata]:
        if self._salvage is not None:
            yield from (content for content in self._salvage.contents() if isinstance(content, Metadata))
            return
        with self.path.open("rb") as file:
            yield from make_reader(file).iter_metadata()

    def _decoded(self, found: _Found) -> Any:
        with self._reading():
            decode = self._decoders.get(found.topic)
            if decode is None:
                decode = DecoderFactory().decoder_for("protobuf", found.schema)
                if decode is None:
                    raise RecordingError(f"{self.path}: {found.topic}: not in a format that this program reads")
                self._decoders[found.topic] = decode
            return decode(found.data)

    def _json(self, found: _Found) -> dict[str, Any]:
        with self._reading():
            content: dict[str, Any] = json.loads(found.data)
            return content

    @contextmanager
    def _reading(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise RecordingError(f"{self.path}: {error.strerror}") from error
        except (*DAMAGE, DecodeError, KeyError) as error:
            raise RecordingError(
                f"{self.path}: damaged: {error}; 'covrecon recording repair {self.path}' recovers what is whole"
            ) from error


def _hand_over(stored: StoredHandOver, waiting: Mapping[KeyframeName, deque[messages.Keyframe]]) -> HandOver:
    found, missing = [], []
    for name in stored.keyframes:
        if waiting.get(name):
            found.append(waiting[name].popleft())
        else:
            missing.append(name)
    return HandOver(stored.tick, tuple(found), tuple(missing))


def _salvaged(salvage: Salvage, topics: Sequence[str] | None) -> Iterator[_Found]:
    schemas: dict[int, Schema] = {}
    known: dict[int, Channel] = {}
    for content in salvage.contents():
        if isinstance(content, Schema):
            schemas[content.id] = content
        elif isinstance(content, Channel):
            known[content.id] = content
        elif isinstance(content, Message):
            channel = known.get(content.channel_id)
            if channel is not None and (topics is None or channel.topic in topics):
                yield _Found(channel.topic, content.log_time, content.data, schemas.get(channel.schema_id))
