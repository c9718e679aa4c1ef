"""The one table of topics: who writes what, how urgent it is, and what may be lost.

Subscriptions, queues, freshness checks and later the recorder and the access rules are made from it.
All keys live under the namespace ``covrecon/<mission name>``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, Literal, TypeVar

from protocol import messages
from protocol.wire import Message

M = TypeVar("M", bound=Message)
Writer = Literal["agent", "ground", "sim"]
Priority = Literal["REAL_TIME", "INTERACTIVE_HIGH", "INTERACTIVE_LOW", "DATA_HIGH", "DATA", "DATA_LOW", "BACKGROUND"]


@dataclass(frozen=True, slots=True)
class Topic(Generic[M]):
    key: str
    """Key expression; ``{drone}`` stands for a drone's id."""
    message: type[M]
    writers: tuple[Writer, ...]
    """Kinds of process that publish it."""
    priority: Priority
    queue: int
    """Messages kept for a slow reader; then the oldest is dropped and counted."""
    max_age_s: float
    """An older value must not be acted on; infinity where age does not matter."""
    recorded: bool
    express: bool = False
    """Sent at once instead of being batched."""
    queryable: bool = False

    def of(self, drone: int | str) -> str:
        """The key of one drone, or of all with ``"*"``."""
        return self.key.format(drone=drone)


_NO_AGE = float("inf")

STATE = Topic("drone/{drone}/state", messages.DroneState, ("agent",), "INTERACTIVE_HIGH", 256, 0.4, True)
KEYFRAME = Topic("drone/{drone}/keyframe", messages.Keyframe, ("agent", "sim"), "DATA_LOW", 256, _NO_AGE, True)
SETPOINT = Topic("drone/{drone}/setpoint", messages.Setpoint, ("agent",), "REAL_TIME", 256, 0.5, True, express=True)
TICK = Topic("clock/tick", messages.Tick, ("sim",), "REAL_TIME", 256, 0.5, True, express=True)
JUMP = Topic("phi/jump", messages.Jump, ("ground",), "DATA_HIGH", 256, _NO_AGE, True)
HEAD = Topic("phi/head", messages.JumpHead, ("ground",), "INTERACTIVE_LOW", 256, 2.0, True, express=True)
JOURNAL = Topic("phi/journal", messages.JournalPage, ("ground",), "BACKGROUND", 16, _NO_AGE, False, queryable=True)
DIGEST = Topic("phi/digest", messages.PhiDigest, ("ground",), "INTERACTIVE_LOW", 16, _NO_AGE, True)
BLOCKS = Topic("phi/blocks", messages.PhiPage, ("ground",), "BACKGROUND", 16, _NO_AGE, False, queryable=True)
DRONE_BLOCKS = Topic(
    "drone/{drone}/phi", messages.PhiPage, ("agent",), "BACKGROUND", 16, _NO_AGE, False, queryable=True
)
PHASE = Topic("command/all", messages.MissionPhase, ("ground",), "REAL_TIME", 16, 2.0, True, express=True)
COMMAND = Topic("command/request", messages.CommandReply, ("ground",), "REAL_TIME", 16, _NO_AGE, False, queryable=True)
EVENT = Topic("drone/{drone}/event", messages.Event, ("agent",), "DATA_HIGH", 256, _NO_AGE, True)
GROUND_EVENT = Topic("ground/event", messages.Event, ("ground",), "DATA_HIGH", 256, _NO_AGE, True)
MAP = Topic("map/blocks", messages.MeshPage, ("ground",), "BACKGROUND", 4, _NO_AGE, False, queryable=True)
STATUS = Topic("status", messages.Status, ("ground",), "INTERACTIVE_LOW", 4, 5.0, True)

TOPICS: tuple[Topic[Message], ...] = (  # type: ignore[assignment]  # read-only use of an invariant generic
    STATE, KEYFRAME, SETPOINT, TICK, JUMP, HEAD, JOURNAL, DIGEST, BLOCKS, DRONE_BLOCKS, PHASE, COMMAND,
    EVENT, GROUND_EVENT, MAP, STATUS,
)  # fmt: skip


def alive_key(role: str) -> str:
    """Liveliness token of a process: ``ground``, ``sim`` or ``drone/<id>``."""
    return f"alive/{role}"
