"""What crosses a process boundary comes out as it went in, or not at all."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from typing import Any, TypeAlias

import msgpack
import numpy as np
import pytest
from pydantic import ValidationError

from protocol import messages
from protocol.errors import MessageError, VersionError
from protocol.messages import (
    UNLIMITED,
    CommandReply,
    Control,
    DroneOrder,
    DroneState,
    DroneStatus,
    Event,
    ExternalMesh,
    ExternalPose,
    FreeCells,
    JournalPage,
    Jump,
    JumpHead,
    Keyframe,
    KeyframePage,
    LidarScan,
    MeshBlock,
    MeshPage,
    MissionPhase,
    PhiDigest,
    PhiPage,
    ReplicaState,
    Setpoint,
    Status,
    TeamStates,
    Tick,
    VehicleSample,
)
from protocol.wire import MAX_MEMBERS, MAX_MESSAGE_BYTES, WIRE_MINOR, WIRE_VERSION, Message, decode, encode

Place: TypeAlias = tuple[str | int, ...]

SAMPLE = VehicleSample(
    drone=2, pose=(0.0, 1.5, 2.0, -0.3, 1.3), velocity=(0.1, -0.5, 0.0, 0.2, -0.1), battery=0.5, setpoint_tick=-1
)
CONTROL = Control(
    tick=41,
    outcome="infeasible",
    velocity=(0.0, 0.25, 0.0, 0.0, 0.0),
    slack=-3.5,
    sampling=812.25,
    solve_s=1e-4,
    separation_margin_m2=0.75,
    region_margin_m=1.5,
    pitch_margin_rad2=0.0625,
    active=("region:+x", "separation:3"),
    fallbacks=1,
    refused=2,
    obstacle_margin_m=-0.125,
)
ROW = DroneStatus(
    drone=1,
    alive=True,
    mode="flying",
    position=(0.5, 1.5, 2.5),
    speed_mps=0.5,
    separation_m=1.25,
    slack=-0.5,
    solve_s=1e-4,
    fallbacks=0,
)
REPLICA = ReplicaState(tick=40, epoch=5, next_jump=1, missing=0, repaired=2, lost=3)
ORDER = DroneOrder(drone=3, action="hold", number=4)
MESH_BLOCK = MeshBlock(
    key=(-1, 0, 2),
    revision=3,
    vertices=np.array([[0.5, 0.0, 1.0], [1.0, 0.0, 1.0], [0.5, 1.0, 1.0]], np.float32),
    faces=np.array([[0, 1, 2]], np.int32),
    colours=np.full((3, 3), 200, np.uint8),
)
EXAMPLES: tuple[Message, ...] = (
    SAMPLE,
    Tick(
        tick=3,
        time_s=0.15,
        lockstep=True,
        live=(1, 2),
        vehicles=(SAMPLE, SAMPLE.model_copy(update={"drone": 7})),
        jump_epoch=2**62,
        next_jump=4,
        keyframes=5,
        contacts=((7, 2),),
    ),
    Setpoint(drone=255, tick=12, velocity=(0.5, -0.5, 0.0, 0.5, -0.5), land=True),
    CONTROL,
    DroneState(
        drone=3,
        tick=42,
        pose=(1.5, 2.5, 3.5, 0.5, 1.25),
        velocity=(0.0, 0.0, 0.5, 0.0, 0.0),
        battery=1.0,
        mode="braking",
        earlier=((41, (1.5, 2.5, 3.0, 0.5, 1.25)), (40, (1.5, 2.5, 2.5, 0.5, 1.25))),
        importance=0.75,
        replica=REPLICA,
        control=CONTROL,
        climb_m=1.5,
    ),
    Keyframe(
        drone=1,
        sequence=9,
        tick=100,
        position=(1.0, 2.0, 3.0),
        rotation=((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)),
        width=320,
        height=180,
        fx=213.5,
        fy=213.5,
        cx=160.0,
        cy=90.0,
        jpeg=b"\xff\xd8\x00\xff\xd9",
        depth=b"\x89PNG\x00",
    ),
    Jump(epoch=5, sequence=0, tick=140, increments=np.array([0.0, 0.5, -1.5], np.float32)),
    JumpHead(epoch=5, next_sequence=1, done=139, phase="flying"),
    JournalPage(epoch=5, first_sequence=1, next_sequence=2, jumps=(b"\x00one", b"two")),
    MissionPhase(phase="finished", reason="J fällt unter 0,1", orders=(ORDER,)),
    ORDER,
    CommandReply(id="a1", accepted=True, text="land: drone 3", number=4, awaited=(3,)),
    Event(source="drone/3", tick=12, level="warning", kind="order", text="land: battery critical (battery at 9%)"),
    MESH_BLOCK,
    MeshPage(epoch=7, revision=3, complete=False, blocks=(MESH_BLOCK,)),
    FreeCells(tick=40, packed=b"\x00\xff"),
    KeyframePage(epoch=7, first=12, next=40, keyframes=(b"\x00one", b"two"), wanted=True),
    ExternalMesh(
        epoch=7,
        taken=40,
        vertices=MESH_BLOCK.vertices,
        faces=MESH_BLOCK.faces,
        colours=MESH_BLOCK.colours,
        fault="none of it",
    ),
    ROW,
    REPLICA,
    PhiDigest(epoch=5, tick=60, sketches=np.array([[0.5, 1.0], [0.25, 0.0]], np.float32)),
    PhiPage(epoch=5, tick=61, next_sequence=1, blocks=np.array([3, 7], np.int32), phi=np.ones((4, 3), np.float32)),
    TeamStates(
        drones=np.array([3, 255], np.uint8),
        ticks=np.array([42, 40], np.int32),
        poses=np.array([[1.5, 2.5, 3.5, 0.5, 1.25], [-1.5, 2.5, 3.5, 0.5, 1.25]]),
        velocities=np.zeros((2, 5)),
        blind_s=np.array([0.0, 1.5]),
        landed=np.array([0, 1], np.uint8),
        earlier_rows=np.array([0], np.uint8),
        earlier_ticks=np.array([41], np.int32),
        earlier_poses=np.array([[1.5, 2.5, 3.0, 0.5, 1.25]]),
    ),
    ExternalPose(
        drone=2,
        tick=12,
        age_s=0.25,
        position=(0.5, -1.5, 2.0),
        attitude=(0.5, 0.5, -0.5, 0.5),
        position_sd_m=0.125,
        angle_sd_rad=0.25,
    ),
    LidarScan(drone=2, tick=12, points=np.array([[100, -20, 30], [5, 6, -32000]], np.int16)),
    Status(
        phase="flying",
        activity="mapping",
        tick=20,
        time_s=1.5,
        importance=0.5,
        f_score_visible=0.25,
        f_score_objects=0.125,
        keyframes=3,
        dropped=1,
        replica=REPLICA,
        refused=4,
        unwritten=1,
        loop_lag_s=0.002,
        keyframes_per_s=2.5,
        jumps=1,
        min_separation_m=1.5,
        drones=(ROW,),
    ),
)
each_message = pytest.mark.parametrize("message", EXAMPLES, ids=lambda message: message.name)
each_array = pytest.mark.parametrize("dtype", ["<f4", "<f8", "<i4", "|u1"])


def unpacked(message: Message) -> dict[str, Any]:
    fields: dict[str, Any] = msgpack.unpackb(encode(message))
    return fields


def places(tree: object, here: Place = ()) -> Iterator[tuple[Place, object]]:
    """Every value inside of a tree of maps and lists, the version and the message's name left out."""
    inner = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in inner:
        if here or key not in ("v", "n"):
            yield (*here, key), value
            yield from places(value, (*here, key))


def replaced(fields: dict[str, Any], place: Place, value: object) -> bytes:
    """The same message with one value exchanged."""
    changed = copy.deepcopy(fields)
    inner: Any = changed
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    packed: bytes = msgpack.packb(changed)
    return packed


def assert_same(one: Message, other: Message) -> None:
    assert type(one) is type(other)
    for field in type(one).model_fields:
        a, b = getattr(one, field), getattr(other, field)
        if isinstance(a, np.ndarray):
            assert a.dtype == b.dtype
            np.testing.assert_array_equal(a, b)
        elif isinstance(a, tuple) and a and isinstance(a[0], MeshBlock):
            for inner, outer in zip(a, b, strict=True):
                assert_same(inner, outer)
        else:
            assert a == b


def jump_bytes(increments: object) -> bytes:
    return replaced(
        unpacked(Jump(epoch=5, sequence=0, tick=1, increments=np.zeros(1, "<f4"))), ("increments",), increments
    )


def test_no_message_is_missing_from_the_examples() -> None:
    defined = {kind for kind in vars(messages).values() if isinstance(kind, type) and issubclass(kind, Message)}

    assert {type(message) for message in EXAMPLES} == defined - {Message}


def test_no_field_takes_the_place_of_the_version_or_the_name() -> None:
    assert all(type(message).model_fields.keys().isdisjoint({"v", "m", "n"}) for message in EXAMPLES)


@each_message
def test_a_message_comes_out_as_it_went_in(message: Message) -> None:
    assert_same(decode(type(message), encode(message)), message)


@each_array
@pytest.mark.parametrize("shape", [(6,), (2, 3), (0,), (0, 4), ()])
def test_an_array_keeps_its_type_shape_and_values(dtype: str, shape: tuple[int, ...]) -> None:
    array = np.arange(math.prod(shape)).reshape(shape).astype(dtype)

    found = decode(Jump, encode(Jump(epoch=1, sequence=0, tick=0, increments=array))).increments

    assert found.dtype == np.dtype(dtype)
    assert found.shape == shape
    np.testing.assert_array_equal(found, array)


def test_an_array_crosses_as_little_endian_bytes_whatever_its_own_order() -> None:
    for array in (np.array([1.0, -2.0], ">f4"), np.array([1.0, -2.0], "<f4"), np.array([1.0, 9.0, -2.0], "<f4")[::2]):
        fields = unpacked(Jump(epoch=1, sequence=0, tick=0, increments=array))

        assert fields["increments"] == ["<f4", [2], b"\x00\x00\x80\x3f\x00\x00\x00\xc0"]


@pytest.mark.parametrize("version", [WIRE_VERSION + 1, 0, None, "1", True, float(WIRE_VERSION), [1]])
def test_another_version_is_refused(version: object) -> None:
    with pytest.raises(VersionError, match=r"jump_head: wire version .* speaks 1"):
        decode(JumpHead, msgpack.packb(unpacked(EXAMPLES[7]) | {"v": version}))


def newer(message: Message) -> bytes:
    """As a release says it that is one minor version ahead and has a new field in everything."""
    fields = _with_new_fields(unpacked(message))
    packed: bytes = msgpack.packb(fields | {"v": WIRE_VERSION, "m": WIRE_MINOR + 1, "n": message.name})
    return packed


def _with_new_fields(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _with_new_fields(below) for key, below in value.items()} | {"new": [1, {"of": "later"}]}
    if isinstance(value, list):
        return [_with_new_fields(below) for below in value]
    return value


@each_message
def test_fields_of_a_newer_minor_version_are_passed_over(message: Message) -> None:
    assert_same(decode(type(message), newer(message)), message)


def test_fields_that_nobody_knows_are_refused_of_the_same_minor_version() -> None:
    for minor in ({}, {"m": WIRE_MINOR}):
        with pytest.raises(MessageError, match=r"jump_head.new"):
            decode(JumpHead, msgpack.packb(_with_new_fields(unpacked(EXAMPLES[7])) | minor))


def test_an_older_minor_versions_message_takes_the_defaults_of_what_it_lacks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("protocol.wire.WIRE_MINOR", 3)
    fields = unpacked(EXAMPLES[4])
    assert fields.pop("m") == 3
    del fields["obeyed"], fields["blind_s"]

    found = decode(DroneState, msgpack.packb(fields))

    assert (found.obeyed, found.blind_s) == (0, 0.0)


def test_a_decision_of_a_release_without_obstacle_margins_has_no_such_row() -> None:
    fields = unpacked(CONTROL) | {"m": 3}
    del fields["obstacle_margin_m"]

    assert decode(Control, msgpack.packb(fields)) == CONTROL.model_copy(update={"obstacle_margin_m": UNLIMITED})


def test_a_keyframe_of_a_release_without_depth_cameras_has_none() -> None:
    (example,) = (message for message in EXAMPLES if isinstance(message, Keyframe))
    fields = unpacked(example) | {"m": 1}
    del fields["depth"]

    assert decode(Keyframe, msgpack.packb(fields)) == example.model_copy(update={"depth": b""})


@pytest.mark.parametrize("attitude", [(0.0, 0.0, 0.0, 0.0), (1.0, 1.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 1.0)])
def test_an_attitude_that_is_no_rotation_is_refused(attitude: tuple[float, ...]) -> None:
    (example,) = (message for message in EXAMPLES if isinstance(message, ExternalPose))
    with pytest.raises(MessageError, match=r"external_pose\.attitude"):
        decode(ExternalPose, msgpack.packb(unpacked(example) | {"attitude": attitude}))


def test_what_does_not_see_a_drone_says_so_by_a_pose_without_place() -> None:
    found = decode(ExternalPose, encode(ExternalPose(drone=1, tick=3, age_s=0.0)))
    assert (found.position, found.attitude) == (None, None)


@pytest.mark.parametrize("minor", [-1, True, 1.0, "1", None, [1]])
def test_a_minor_version_that_is_no_number_is_refused(minor: object) -> None:
    with pytest.raises(MessageError, match=r"jump_head: minor wire version"):
        decode(JumpHead, msgpack.packb(unpacked(EXAMPLES[7]) | {"m": minor}))


@pytest.mark.parametrize("field", ["epoch", "next_sequence"])
def test_a_newer_minor_version_must_still_have_what_this_one_needs(field: str) -> None:
    fields = unpacked(EXAMPLES[7]) | {"m": WIRE_MINOR + 1}
    del fields[field]
    with pytest.raises(MessageError, match=field):
        decode(JumpHead, msgpack.packb(fields))


def test_a_message_of_another_name_is_refused() -> None:
    with pytest.raises(MessageError, match="drone_status: holds a message 'status'"):
        decode(DroneStatus, encode(EXAMPLES[-1]))
    with pytest.raises(MessageError, match="jump_head: holds a message None"):
        decode(JumpHead, msgpack.packb({"v": 1, "epoch": 5, "next_sequence": 1, "done": 139, "phase": "flying"}))


@each_message
def test_every_field_without_a_default_is_required(message: Message) -> None:
    for field, declared in type(message).model_fields.items():
        if not declared.is_required():
            continue
        fields = unpacked(message)
        del fields[field]
        with pytest.raises(MessageError, match=rf"{message.name}\.{field}: Field required"):
            decode(type(message), msgpack.packb(fields))


@each_message
def test_an_unknown_field_is_refused_at_every_depth(message: Message) -> None:
    fields = unpacked(message)
    tables = [(), *(place for place, value in places(fields) if isinstance(value, dict))]
    for table in tables:
        with pytest.raises(MessageError, match="not permitted"):
            decode(type(message), replaced(fields, (*table, "surprise"), 1))


@each_message
def test_a_number_that_is_not_finite_is_refused_wherever_it_stands(message: Message) -> None:
    fields = unpacked(message)
    for place, value in places(fields):
        if isinstance(value, float):
            for bad in (math.nan, math.inf, -math.inf):
                with pytest.raises(MessageError):
                    decode(type(message), replaced(fields, place, bad))


@each_message
def test_a_value_of_another_type_is_refused_wherever_it_stands(message: Message) -> None:
    """Nothing is converted: no "3" for 3, no true for 1, no 1.0 for 1, no text for bytes."""
    fields = unpacked(message)
    optional = {"control", "climb_m"} | ({"position", "attitude"} if isinstance(message, ExternalPose) else set())
    for place, value in places(fields):
        others: list[object] = ["3", b"3", True, None, 2.5, 3, [], {}]
        same_kind = (int, float) if type(value) is float else (type(value),)
        for other in others:
            if type(other) in same_kind or (other is None and place[-1] in optional):
                continue
            with pytest.raises(MessageError):
                decode(type(message), replaced(fields, place, other))


def test_numbers_out_of_range_are_refused() -> None:
    for field, bad in [("drone", 0), ("drone", 256), ("tick", -1), ("battery", 1.01), ("battery", -0.01)]:
        with pytest.raises(MessageError, match=rf"state\.{field}: "):
            decode(DroneState, replaced(unpacked(EXAMPLES[4]), (field,), bad))


@each_message
def test_truncated_bytes_are_refused_wherever_they_end(message: Message) -> None:
    data = encode(message)
    for length in range(len(data)):
        with pytest.raises(MessageError):
            decode(type(message), data[:length])


def test_bytes_behind_a_message_are_refused() -> None:
    with pytest.raises(MessageError, match="extra data"):
        decode(MissionPhase, encode(EXAMPLES[9]) + b"\x00")


@pytest.mark.parametrize(
    ("increments", "fault"),
    [
        (["<f4", [2], bytes(7)], "7 bytes do not fill shape"),
        (["<f4", [2], bytes(12)], "12 bytes do not fill shape"),
        (["<f8", [2], bytes(8)], "8 bytes do not fill shape"),
        (["<f4", [2**24, 2**24], b""], "0 bytes do not fill shape"),
        (["<f4", [2**40, 2**40], b""], "not made of lengths"),
        (["<f4", [-1, -2], bytes(8)], "not made of lengths"),
        (["<f4", [True, 2], bytes(8)], "not made of lengths"),
        (["<f4", [2.0], bytes(8)], "not made of lengths"),
        (["<f4", [0, 2**64 - 1], b""], "not made of lengths"),
        (["<f4", [0, 0, 0, 0, 0], b""], "5 dimensions exceed the limit of 4"),
        (["<f4", [0] * MAX_MEMBERS, b""], f"{MAX_MEMBERS} dimensions exceed the limit of 4"),
        ([">f4", [2], bytes(8)], "not an array"),
        (["|O", [1], bytes(8)], "not an array"),
        (["<f4", 2, bytes(8)], "not an array"),
        (["<f4", [2], "12345678"], "not an array"),
        ([1.0, 2.0], "not an array"),
        (["<f4", [1], np.float32(np.nan).tobytes()], "not finite"),
        (["<f8", [1], np.float64(-np.inf).tobytes()], "not finite"),
    ],
)
def test_an_array_that_does_not_fit_is_refused(increments: object, fault: str) -> None:
    with pytest.raises(MessageError, match=rf"jump\.increments: .*{fault}"):
        decode(Jump, jump_bytes(increments))


@pytest.mark.parametrize("increments", [np.array([np.nan], np.float32), np.zeros(2, np.int64), np.array(["text"])])
def test_what_every_receiver_would_refuse_cannot_be_made_into_a_message(increments: np.ndarray) -> None:
    with pytest.raises(ValidationError):
        Jump(epoch=1, sequence=0, tick=0, increments=increments)


def test_a_message_beyond_the_limit_is_refused_by_sender_and_receiver() -> None:
    frame = EXAMPLES[5]
    room = MAX_MESSAGE_BYTES - len(encode(frame.model_copy(update={"jpeg": bytes(2**16)}))) + 2**16
    largest = frame.model_copy(update={"jpeg": bytes(room)})
    assert len(encode(largest)) == MAX_MESSAGE_BYTES
    decode(Keyframe, encode(largest))

    with pytest.raises(MessageError, match="exceed the limit"):
        encode(frame.model_copy(update={"jpeg": bytes(room + 1)}))
    with pytest.raises(MessageError, match="exceed the limit"):
        decode(Keyframe, encode(largest) + b"\x00")
