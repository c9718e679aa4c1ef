"""What a mission puts on the links of its drones, in bytes of IP packets a second: to be planned before it is flown.

Sizes are those of really encoded messages (`protocol.traffic_samples`), rates follow from the mission, and what the
transport adds was measured: with zenoh 1.10 over TLS 1.3 and TCP, in flights over hosts of their own, every message
travels in a frame, a record and a segment or more of its own. `tests/scenario/test_traffic.py` compares.

Left out is what does not flow steadily: events, commands, and what a replica fetches when it starts or has drifted.
Keep-alives are sent on silent links alone, and none of these is.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

from protocol import topics, traffic_samples
from protocol.aggregator import is_gathered
from protocol.mission import Mission
from protocol.topics import Topic
from protocol.wire import Message, encode

Direction = Literal["up", "down"]
"""From a drone to the router, and back."""

IRREGULAR: tuple[Topic[Any], ...] = (topics.EVENT, topics.JOURNAL, topics.BLOCKS, topics.DRONE_BLOCKS)
"""Topics of agents that do not flow steadily."""
HEAD_EVERY_TICKS = 4
"""As the ground station does in real time (`ground_station.ground_station`), ..."""
PHASE_PERIOD_S = 0.5
"""... likewise."""
JPEG_BYTES_PER_PIXEL = 0.36
"""Mean of 60 images of the built-in room at 320 x 180 pixels and quality 90: 20.8 kB; 95 % have less than 0.46."""
DEPTH_BYTES_PER_PIXEL = 1.3
"""Likewise of its depth images: their noise hardly compresses."""

FRAME_BYTES = 14
"""What zenoh adds to a message: the batch's length (2), the frame's and the message's headers and numbers, beside the
length of the payload and of the key."""
FRAGMENT_BYTES, BATCH_BYTES = 11, 65_535
"""A longer message is cut into batches, each with a header more."""
TLS_RECORD_BYTES, TLS_RECORD_MAX_BYTES = 22, 16_384
"""Header, type and tag of a record of TLS 1.3, and what fits in one."""
HEADER_BYTES = 52
"""IPv4 (20), TCP (20) and its time stamps (12): of each segment, and all that an acknowledgement is."""
MTU_BYTES = 1500
ACKNOWLEDGED_SHARE = 0.45
"""Acknowledgements without data for each segment with data, measured 0.32 to 0.50: of as many ..."""
BURST_SEGMENTS = 8
"""... as come with one tick; of a longer burst ..."""
BURST_SHARE = 0.25
"""... several are acknowledged at once."""


@dataclass(frozen=True, slots=True)
class Carrier:
    """What messages travel in."""

    tls: bool = True
    mtu_bytes: int = MTU_BYTES
    """Of IP packets; 65536 on the loopback device."""

    def stream_bytes(self, message_bytes: int, key_bytes: int = 0) -> int:
        """Of the TCP stream, for one message; ``key_bytes``: of its key that is spelt out."""
        framed = message_bytes + key_bytes + FRAME_BYTES + _length_bytes(message_bytes)
        framed += FRAGMENT_BYTES * ((framed - 1) // BATCH_BYTES)
        return framed + (TLS_RECORD_BYTES * math.ceil(framed / TLS_RECORD_MAX_BYTES) if self.tls else 0)

    def segments(self, stream_bytes: int) -> int:
        return math.ceil(stream_bytes / (self.mtu_bytes - HEADER_BYTES))


@dataclass(frozen=True, slots=True)
class Flow:
    """The messages of one topic on one drone's link."""

    topic: str
    direction: Direction
    rate_hz: float
    message_bytes: int
    """As encoded."""
    packet_bytes: int
    """Of the IP packets that carry one message."""
    segments: int
    """How many these are."""

    @property
    def bytes_per_s(self) -> float:
        return self.rate_hz * self.packet_bytes


@dataclass(frozen=True, slots=True)
class Plan:
    """What the mission file does not say."""

    jpeg_bytes: int | None = None
    """Of one image. None: as many as the built-in room's of that size take, where the drone has a real camera; a
    simulator's images pass no drone's link."""
    speed_mps: float | None = None
    """Mean speed, for how often a camera has moved enough. None: as fast as the mission allows."""
    gathered: bool | None = None
    """Whether the router gathers states. None: as the mission says."""
    carrier: Carrier = Carrier()


@dataclass(frozen=True, slots=True)
class Traffic:
    """Of one drone's link."""

    flows: tuple[Flow, ...]
    ticks_hz: float

    def acknowledgements(self, direction: Direction) -> float:
        """Bytes a second of those that travel in ``direction``."""
        answered = sum(flow.rate_hz * flow.segments for flow in self.flows if flow.direction != direction)
        steady = min(answered, BURST_SEGMENTS * self.ticks_hz)
        return HEADER_BYTES * (ACKNOWLEDGED_SHARE * steady + BURST_SHARE * (answered - steady))

    def bytes_per_s(self, direction: Direction) -> float:
        told = sum(flow.bytes_per_s for flow in self.flows if flow.direction == direction)
        return told + self.acknowledgements(direction)


def traffic_of(mission: Mission, drone: int, plan: Plan | None = None) -> Traffic:
    """Of the link between a drone, or whatever computer flies it, and the router."""
    plan = plan or Plan()
    flows = tuple(_flow(plan.carrier, *told) for told in _told(mission, drone, plan))
    return Traffic(flows, mission.controller.rate_hz)


def radio_bytes_per_s(mission: Mission, plan: Plan | None = None) -> float:
    """Of all drones, both ways: what an access point carries that they all share, the router behind it by wire."""
    loads = [traffic_of(mission, drone.id, plan) for drone in mission.drones]
    return sum(load.bytes_per_s("up") + load.bytes_per_s("down") for load in loads)


def default_jpeg_bytes(mission: Mission) -> int:
    return round(JPEG_BYTES_PER_PIXEL * mission.camera.width_px * mission.camera.height_px)


def default_depth_bytes(mission: Mission) -> int:
    """0 without depth cameras."""
    camera = mission.sweep_intrinsics()
    return round(DEPTH_BYTES_PER_PIXEL * camera.width * camera.height) if mission.measures_depth else 0


def keyframe_rate_hz(mission: Mission, speed_mps: float | None = None) -> float:
    """Of one camera that moves at ``speed_mps`` and turns in proportion; None: both as fast as the mission allows.

    By baseline or by angle, whichever comes first, and looked at once a tick.
    """
    flight, camera = mission.flight, mission.camera
    fastest_mps, fastest_radps = math.sqrt(3) * flight.speed_max_mps, max(flight.velocity_limits[3:])
    share = 1.0 if speed_mps is None else min(1.0, speed_mps / fastest_mps)
    if share <= 0:
        return 0.0
    first_s = min(camera.keyframe_baseline_m / fastest_mps, camera.keyframe_angle_rad / fastest_radps) / share
    return 1 / (mission.tick_s * math.ceil(first_s / mission.tick_s - 1e-9))


def _told(mission: Mission, drone: int, plan: Plan) -> Iterator[tuple[Topic[Any], Direction, float, Message, int]]:
    """Topic, direction, rate, message, and bytes of its key that are spelt out."""
    rate_hz = mission.controller.rate_hz
    yield topics.STATE, "up", rate_hz, traffic_samples.state(drone, obstacles=mission.flight.obstacles.enabled), 0
    if mission.vehicles.kind == "simulated":
        yield topics.SETPOINT, "up", rate_hz, traffic_samples.setpoint(drone), 0
    jpeg_bytes = plan.jpeg_bytes
    if jpeg_bytes is None and mission.drone(drone).camera:
        jpeg_bytes = default_jpeg_bytes(mission)
    if jpeg_bytes is not None:
        image = traffic_samples.keyframe(mission, drone, jpeg_bytes, default_depth_bytes(mission))
        yield topics.KEYFRAME, "up", keyframe_rate_hz(mission, plan.speed_mps), image, 0

    yield topics.TICK, "down", rate_hz, traffic_samples.tick(mission), 0
    gathered = is_gathered(mission, lockstep=False) if plan.gathered is None else plan.gathered
    if gathered:
        yield topics.TEAM, "down", rate_hz, traffic_samples.team_states(mission), 0
    else:
        for other in mission.drones:
            if other.id != drone:
                message = traffic_samples.state(other.id, obstacles=mission.flight.obstacles.enabled)
                yield topics.STATE, "down", rate_hz, message, _spelt_bytes(topics.STATE, other.id)
    if mission.localization.source == "lidar":
        yield topics.SCAN, "down", rate_hz / mission.scan_ticks, traffic_samples.scan(mission, drone), 0
    if mission.localization.source == "mocap":
        yield topics.MOCAP, "down", mission.mocap.rate_hz, traffic_samples.external_pose(drone), 0
    yield topics.HEAD, "down", rate_hz / HEAD_EVERY_TICKS, traffic_samples.head(), 0
    yield topics.PHASE, "down", 1 / PHASE_PERIOD_S, traffic_samples.phase(), 0
    yield topics.DIGEST, "down", 1 / mission.replication.digest_period_s, traffic_samples.digest(mission), 0
    if mission.flight.obstacles.enabled:
        yield topics.FREE, "down", 1 / mission.flight.obstacles.period_s, traffic_samples.free_cells(mission), 0
    if mission.feedback.method != "none" and mission.reconstruction.backend != "none":
        yield topics.JUMP, "down", 1 / mission.feedback.period_s, traffic_samples.jump(mission), 0


def _flow(
    carrier: Carrier, topic: Topic[Any], direction: Direction, rate_hz: float, message: Message, key_bytes: int
) -> Flow:
    size = len(encode(message))
    stream_bytes = carrier.stream_bytes(size, key_bytes)
    segments = carrier.segments(stream_bytes)
    return Flow(topic.key, direction, rate_hz, size, stream_bytes + HEADER_BYTES * segments, segments)


def _spelt_bytes(topic: Topic[Any], drone: int) -> int:
    """Of a key that a reader has asked for with ``*``: from there on it travels as it is, after its length."""
    return 1 + len(topic.of(drone)) - len(topic.key.partition("/{drone}")[0])


def _length_bytes(size: int) -> int:
    """Seven bits each."""
    return max(1, math.ceil(size.bit_length() / 7))
