"""What this project itself stores in a recording, as JSON: Foxglove plots it, and floats come back to the last bit."""

from __future__ import annotations

import base64
from typing import Annotated, Any, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, create_model

from protocol import messages
from protocol.messages import Count, DroneId, TickNumber, Vector5
from protocol.wire import Finite

RECORDING_VERSION = 1
"""Of all that is stored here; a reader refuses another."""
_KEPT = ("type", "title", "description", "contentEncoding")
INCREMENT = np.dtype("<f4")


class Stored(BaseModel):
    """Base of what is written and read back."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class StoredMission(Stored):
    """First message of every recording."""

    version: int
    resumed: bool
    """Whether the ground station had been flying before: phi and the map do not begin here."""
    lossless: bool
    """In lockstep: nothing was dropped, and jumps were on time."""
    epoch_ns: Count
    """Unix time of tick 0 in all log times."""
    mission: dict[str, Any]


class StoredHandOver(Stored):
    tick: TickNumber
    keyframes: tuple[tuple[DroneId, Count], ...]
    """Drone and sequence number, in the map's order."""


class StoredLook(Stored):
    tick: TickNumber
    importance: Finite


class StoredTick(Stored):
    tick: TickNumber
    ids: tuple[DroneId, ...]
    poses: tuple[Vector5, ...]


class StoredJump(Stored):
    look: TickNumber
    """Tick of the look that it came from."""
    epoch: Count
    sequence: Count
    tick: TickNumber
    """When it takes effect."""
    increments: Annotated[str, Field(json_schema_extra={"contentEncoding": "base64"})]
    """Little-endian float32, one for each position."""

    @classmethod
    def of(cls, look: int, jump: messages.Jump) -> Self:
        content = np.ascontiguousarray(jump.increments, INCREMENT).tobytes()
        return cls(
            look=look,
            epoch=jump.epoch,
            sequence=jump.sequence,
            tick=jump.tick,
            increments=base64.b64encode(content).decode("ascii"),
        )

    def jump(self) -> messages.Jump:
        """Raises ValueError when the increments are not what `of` writes."""
        increments = np.frombuffer(base64.b64decode(self.increments, validate=True), INCREMENT)
        return messages.Jump(
            epoch=self.epoch, sequence=self.sequence, tick=self.tick, increments=increments.astype(np.float32)
        )


IMAGES = frozenset({"jpeg", "depth"})
"""Fields of a keyframe that are recorded on channels of their own, where players show them."""
_KEYFRAME: dict[str, Any] = {
    name: (field.annotation, field) for name, field in messages.Keyframe.model_fields.items() if name not in IMAGES
}
StoredKeyframe: type[Stored] = create_model("StoredKeyframe", __base__=Stored, **_KEYFRAME)
"""A keyframe without its images, which are the messages before it on the drone's camera and depth channels."""


def schema_of(model: type) -> dict[str, Any]:
    """JSON schema of a model or dataclass in the part of JSON Schema that players of recordings understand.

    No references, no unions, no lists in lists: an optional value is described as if it were there, and what cannot be
    described is left out; it is in the messages all the same.
    """
    schema = TypeAdapter[Any](model).json_schema(mode="serialization")
    return _plain(schema, schema.get("$defs", {})) or {"type": "object"}


def _plain(schema: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any] | None:
    """None for what cannot be described."""
    if "$ref" in schema:
        return _plain(definitions[schema["$ref"].rsplit("/", 1)[-1]], definitions)
    if "anyOf" in schema:
        real = [option for option in schema["anyOf"] if option.get("type") != "null"]
        return _plain(real[0], definitions) if len(real) == 1 else None
    kept: dict[str, Any] = {
        key: schema[key] for key in ("type", "title", "description", "contentEncoding") if key in schema
    }
    match schema.get("type"):
        case "object":
            properties = {name: _plain(part, definitions) for name, part in schema.get("properties", {}).items()}
            kept["properties"] = {name: part for name, part in properties.items() if part is not None}
        case "array":
            members = schema.get("prefixItems") or [schema.get("items", {})]
            items = _plain(members[0], definitions)
            if items is None or items["type"] == "array":
                return None
            kept["items"] = items
        case "string" | "number" | "integer" | "boolean":
            pass
        case _:
            return None
    return kept
