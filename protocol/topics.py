"""The one table of topics: who writes what and who reads it, how urgent it is, and what may be lost.

Subscriptions, queues, freshness checks, the recorder and the access rules (`protocol.access`) are made from it.
All keys live under the namespace ``covrecon/<mission name>``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, Literal, Protocol, TypeVar

from protocol import messages
from protocol.errors import MessageError
from protocol.wire import MAX_MESSAGE_BYTES, Message, decode

M = TypeVar("M", bound=Message)
Party = Literal["agent", "ground", "sim", "operator", "mapper", "mocap", "router"]
"""Kinds of process. sim: the internal simulator or the observer; operator: console, command line, live table; mapper: a
process of the user's own that makes the map; mocap: what passes on the poses of motion capture. What the router itself
reads and writes passes no access rules: they are its own."""
Priority = Literal["REAL_TIME", "INTERACTIVE_HIGH", "INTERACTIVE_LOW", "DATA_HIGH", "DATA", "DATA_LOW", "BACKGROUND"]


class Payload(Protocol):
    """As zenoh hands it over."""

    def __len__(self) -> int: ...
    def to_bytes(self) -> bytes: ...


@dataclass(frozen=True, slots=True)
class Topic(Generic[M]):
    key: str
    """Key expression; ``{drone}`` stands for a drone's id."""
    message: type[M]
    writers: tuple[Party, ...]
    """Who publishes it, or answers to it."""
    readers: tuple[Party, ...]
    """Who subscribes to it, or asks."""
    priority: Priority
    queue: int
    """Messages kept for a slow reader; then the oldest is dropped and counted."""
    max_age_s: float
    """An older value must not be acted on; infinity where age does not matter."""
    recorded: bool
    max_bytes: int
    """A longer message is refused where it arrives: several times what a mission at its limits needs."""
    express: bool = False
    """Sent at once instead of being batched."""
    queryable: bool = False

    def of(self, drone: int | str) -> str:
        """The key of one drone, or of all with ``"*"``."""
        return self.key.format(drone=drone)

    def read(self, key: str, payload: Payload) -> M:
        """The message that came under ``key``. Raises `MessageError` for what must not be believed."""
        if len(payload) > self.max_bytes:
            raise MessageError(f"{self.message.name}: {len(payload)} bytes exceed the limit of {self.max_bytes}")
        message = decode(self.message, payload.to_bytes())
        contradiction = self.contradiction(key, message)
        if contradiction:
            raise MessageError(f"{self.message.name}: {contradiction}")
        return message

    def contradiction(self, key: str, message: Message) -> str:
        """How ``message`` speaks for another drone than the one whose key it came under; empty if it does not.

        Access control judges keys alone, so that a drone could write its neighbour's position under its own.
        """
        before, mark, after = self.key.partition("{drone}")
        if not mark:
            return ""
        drone = key.removeprefix(before).removesuffix(after)
        claimed = message.source if isinstance(message, messages.Event) else f"drone/{getattr(message, 'drone', drone)}"
        return "" if claimed == f"drone/{drone}" else f"speaks for {claimed}"


_NO_AGE = float("inf")

_KIB, _MIB = 2**10, 2**20

# fmt: off
STATE = Topic("drone/{drone}/state", messages.DroneState, ("agent",), ("agent", "ground", "sim", "operator", "router"),
              "INTERACTIVE_HIGH", 256, 0.4, True, 16 * _KIB)
TEAM = Topic("team/states", messages.TeamStates, ("router",), ("agent",),
             "INTERACTIVE_HIGH", 16, 0.4, False, 256 * _KIB)
KEYFRAME = Topic("drone/{drone}/keyframe", messages.Keyframe, ("agent", "sim"), ("ground", "operator"),
                 "DATA_LOW", 256, _NO_AGE, True, 12 * _MIB)
SETPOINT = Topic("drone/{drone}/setpoint", messages.Setpoint, ("agent",), ("sim",),
                 "REAL_TIME", 256, 0.5, True, 1 * _KIB, express=True)
SCAN = Topic("drone/{drone}/scan", messages.LidarScan, ("sim",), ("agent",),
             "DATA_HIGH", 4, 0.5, False, 512 * _KIB)
MOCAP = Topic("drone/{drone}/mocap", messages.ExternalPose, ("sim", "mocap"), ("agent",),
              "REAL_TIME", 16, 0.5, False, 1 * _KIB, express=True)
TICK = Topic("clock/tick", messages.Tick, ("sim",), ("agent", "ground", "operator", "mocap", "router"),
             "REAL_TIME", 256, 0.5, True, 256 * _KIB, express=True)
JUMP = Topic("phi/jump", messages.Jump, ("ground",), ("agent", "operator"),
             "DATA_HIGH", 256, _NO_AGE, True, 8 * _MIB)
HEAD = Topic("phi/head", messages.JumpHead, ("ground",), ("agent", "sim", "operator"),
             "INTERACTIVE_LOW", 256, 2.0, True, 1 * _KIB, express=True)
JOURNAL = Topic("phi/journal", messages.JournalPage, ("ground",), ("agent", "operator"),
                "BACKGROUND", 16, _NO_AGE, False, MAX_MESSAGE_BYTES, queryable=True)
DIGEST = Topic("phi/digest", messages.PhiDigest, ("ground",), ("agent", "operator"),
               "INTERACTIVE_LOW", 16, _NO_AGE, True, 8 * _MIB)
BLOCKS = Topic("phi/blocks", messages.PhiPage, ("ground",), ("agent", "operator"),
               "BACKGROUND", 16, _NO_AGE, False, MAX_MESSAGE_BYTES, queryable=True)
DRONE_BLOCKS = Topic("drone/{drone}/phi", messages.PhiPage, ("agent",), ("agent", "ground", "operator"),
                     "BACKGROUND", 16, _NO_AGE, False, MAX_MESSAGE_BYTES, queryable=True)
PHASE = Topic("command/all", messages.MissionPhase, ("ground",), ("agent", "sim", "operator", "mocap"),
              "REAL_TIME", 16, 2.0, True, 256 * _KIB, express=True)
COMMAND = Topic("command/request", messages.CommandReply, ("ground",), ("operator",),
                "REAL_TIME", 16, _NO_AGE, False, 16 * _KIB, queryable=True)
EVENT = Topic("drone/{drone}/event", messages.Event, ("agent",), ("ground", "operator"),
              "DATA_HIGH", 256, _NO_AGE, True, 16 * _KIB)
GROUND_EVENT = Topic("ground/event", messages.Event, ("ground",), ("operator",),
                     "DATA_HIGH", 256, _NO_AGE, True, 16 * _KIB)
MAP = Topic("map/blocks", messages.MeshPage, ("ground",), ("operator",),
            "BACKGROUND", 4, _NO_AGE, False, MAX_MESSAGE_BYTES, queryable=True)
FREE = Topic("map/free", messages.FreeCells, ("ground",), ("agent", "operator"),
             "DATA_HIGH", 16, _NO_AGE, False, 2 * _MIB)
MAP_KEYFRAMES = Topic("map/keyframes", messages.KeyframePage, ("ground",), ("mapper",),
                      "DATA_LOW", 4, _NO_AGE, False, MAX_MESSAGE_BYTES, queryable=True)
EXTERNAL_MESH = Topic("map/external", messages.ExternalMesh, ("mapper",), ("ground",),
                      "DATA_LOW", 4, _NO_AGE, False, MAX_MESSAGE_BYTES)
STATUS = Topic("status", messages.Status, ("ground",), ("operator",),
               "INTERACTIVE_LOW", 4, 5.0, True, 256 * _KIB)
# fmt: on

TOPICS: tuple[Topic[Message], ...] = (  # type: ignore[assignment]  # read-only use of an invariant generic
    STATE, TEAM, KEYFRAME, SETPOINT, SCAN, MOCAP, TICK, JUMP, HEAD, JOURNAL, DIGEST, BLOCKS, DRONE_BLOCKS, PHASE,
    COMMAND, EVENT, GROUND_EVENT, MAP, FREE, MAP_KEYFRAMES, EXTERNAL_MESH, STATUS,
)  # fmt: skip


def alive_key(role: str) -> str:
    """Liveliness token of a process: ``ground``, ``sim`` or ``drone/<id>``."""
    return f"alive/{role}"
