from __future__ import annotations

import io
import math
from itertools import product

import foxglove.messages
import numpy as np
import pytest
import trimesh
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory

from faults.recorded import a_mesh, state
from ground_station.recording import shapes
from ground_station.recording.channels import CHANNELS, MESH, METRICS, SUMMARY
from ground_station.recording.stored import StoredJump, StoredKeyframe, schema_of
from ground_station.results import Metrics
from protocol import messages
from protocol.geometry import Floats, camera_rotation
from protocol.obstacle_grid import ObstacleGrid


def decoded(message: object) -> object:
    """As an independent reader sees it."""
    described = message.get_schema()  # type: ignore[attr-defined]
    schema = Schema(id=1, name=described.name, encoding=described.encoding, data=described.data)
    decode = DecoderFactory().decoder_for("protobuf", schema)
    assert decode is not None
    return decode(message.encode())  # type: ignore[attr-defined]


def rotation(quaternion: object) -> Floats:
    x, y, z, w = (getattr(quaternion, axis) for axis in "xyzw")
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.9])
@pytest.mark.parametrize("pitch", [0.0, 0.4, math.pi / 3, math.pi / 2])
def test_the_cameras_frame_is_that_of_its_images(yaw: float, pitch: float) -> None:
    told = state(3, 5, random=np.random.default_rng(1)).model_copy(update={"pose": (1.0, 2.0, 3.0, yaw, pitch)})
    body, camera = decoded(shapes.transforms(told, 0)).transforms  # type: ignore[attr-defined]
    assert [body.parent_frame_id, body.child_frame_id] == ["world", "drone_3"]
    assert [camera.parent_frame_id, camera.child_frame_id] == ["drone_3", "camera_3"]
    assert (body.translation.x, body.translation.y, body.translation.z) == (1, 2, 3)
    found = rotation(body.rotation) @ rotation(camera.rotation)
    np.testing.assert_allclose(found, camera_rotation(yaw, pitch), atol=1e-12)


def test_a_player_that_turns_models_as_foxglove_does_shows_the_map_where_it_is() -> None:
    mesh = a_mesh(np.random.default_rng(1))
    (entity,) = decoded(shapes.scene(mesh, 0)).entities  # type: ignore[attr-defined]
    (model,) = entity.models
    shown = trimesh.load_mesh(io.BytesIO(model.data), file_type="glb", process=False).vertices
    upright = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])  # what Foxglove does to glTF: z to x, x to y, y to z
    placed = shown @ upright.T @ rotation(model.pose.orientation).T
    np.testing.assert_allclose(placed, mesh.vertices, atol=1e-6)


def test_points_are_coloured_by_their_importance() -> None:
    positions = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]])
    cloud = decoded(shapes.cloud(positions, np.array([0.0, 0.5, 1.0], np.float32), 0))
    data = np.frombuffer(cloud.data, np.uint8).reshape(3, cloud.point_stride)  # type: ignore[attr-defined]
    offsets = {field.name: field.offset for field in cloud.fields}  # type: ignore[attr-defined]
    assert [data[0, offsets[name]] for name in ("red", "green", "blue", "alpha")] == [13, 8, 135, 255]
    assert [data[2, offsets[name]] for name in ("red", "green", "blue", "alpha")] == [240, 249, 33, 255]
    assert data[1, offsets["z"] : offsets["z"] + 4].tobytes() == np.float32(6).tobytes()


def test_free_space_ends_where_a_cell_that_is_free_meets_one_that_is_not() -> None:
    grid = ObstacleGrid(np.array([1.0, -2.0, 0.5]), 0.25, (5, 4, 3), *np.zeros((2, 5, 4, 3), np.bool_))
    free = np.zeros(grid.shape, np.bool_)
    free[2, 1:, 0] = free[2, 2, 1] = True
    wanted = set()
    for index in product(*map(range, grid.shape)):
        for axis, step in product(range(3), (-1, 1)):
            other = list(index)
            other[axis] += step
            above = other[2] == grid.shape[2]
            inside = all(0 <= at < count for at, count in zip(other, grid.shape, strict=True))
            if not free[index] and (above or (inside and free[tuple(other)])):
                wanted.add(tuple((grid.origin + grid.cell_m * (np.array(index) + 0.5)).tolist()))
    cloud = decoded(shapes.free_surface(grid, free, 0))
    assert [(field.name, field.offset) for field in cloud.fields] == [("x", 0), ("y", 4), ("z", 8)]  # type: ignore[attr-defined]
    places = np.frombuffer(cloud.data, "<f4").reshape(-1, cloud.point_stride // 4)  # type: ignore[attr-defined]
    assert len(places) == len(wanted)
    assert set(map(tuple, places.tolist())) == wanted


def test_events_keep_their_level_and_say_who_speaks() -> None:
    event = messages.Event(source="drone/3", tick=1, level="error", kind="solver", text="brakes")
    line = decoded(shapes.log_line(event, 1_500_000_000))
    assert (line.name, line.message, line.level) == ("drone/3", "solver: brakes", 4)  # type: ignore[attr-defined]
    assert (line.timestamp.seconds, line.timestamp.nanos) == (1, 500_000_000)  # type: ignore[attr-defined]


def test_schemas_use_only_what_players_understand() -> None:
    def check(schema: dict[str, object]) -> None:
        assert not {"$ref", "anyOf", "oneOf", "allOf", "prefixItems"} & schema.keys()
        assert schema["type"] in {"object", "array", "string", "number", "integer", "boolean"}
        for part in (schema.get("properties") or {}).values():  # type: ignore[attr-defined]
            check(part)
        if schema["type"] == "array":
            assert schema["items"]["type"] != "array"  # type: ignore[index]
            check(schema["items"])  # type: ignore[arg-type]

    for model in (messages.DroneState, messages.Status, messages.MissionPhase, StoredKeyframe, Metrics):
        schema = schema_of(model)
        check(schema)
        assert schema["type"] == "object"
    properties = schema_of(messages.DroneState)["properties"]
    assert properties["control"]["properties"]["slack"]["type"] == "number"
    assert properties["pose"]["items"]["type"] == "number"


def test_every_increment_of_a_jump_survives_and_a_torn_one_is_refused() -> None:
    jump = messages.Jump(epoch=1, sequence=2, tick=3, increments=np.array([1e-30, 1 / 3], np.float32))
    stored = StoredJump.of(1, jump)
    assert stored.jump().increments.tobytes() == jump.increments.tobytes()
    with pytest.raises(ValueError, match="buffer size"):
        stored.model_copy(update={"increments": stored.increments[:4]}).jump()


def test_every_channel_belongs_to_one_kind_of_entry() -> None:
    names = [name for names in CHANNELS.values() for name in names]
    assert len(names) == len(set(names))
    assert {MESH, METRICS, SUMMARY} <= set(names)
    assert foxglove.messages.SceneUpdate.get_schema().name == "foxglove.SceneUpdate"
