from __future__ import annotations

import json
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from faults.disk import FullDisk
from faults.recorded import Flight, a_mesh, keyframe, state, team
from ground_station.mesh_files import glb, ply
from ground_station.recording.entries import HandOver, IntegratedTick, JumpRecord, Look
from ground_station.recording.reader import Recording
from ground_station.recording.recorder import Recorder, recording_path
from protocol import messages, topics
from protocol.errors import StorageError
from protocol.field import VirtualField
from protocol.mission import Mission
from protocol.obstacle_grid import ObstacleGrid
from protocol.operation_settings import Recording as RecordingSettings
from protocol.replication import Integrated

TICKS = 90


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Flight]:
    """A recording, and what was given to the recorder."""
    path = tmp_path_factory.mktemp("run") / "recording.mcap"
    flight = Flight(team())
    with Recorder(path, flight.mission, lossless=True) as recorder:
        flight.fly(recorder, range(TICKS))
        flight.finish(recorder, TICKS)
    return path, flight


def short_of_room(queue: int = 16) -> Mission:
    return team().model_copy(update={"recording": RecordingSettings(queue=queue)})


def test_an_independent_reader_finds_on_each_channel_all_that_was_published(flown: tuple[Path, Flight]) -> None:
    path, flight = flown
    counts: dict[str, int] = {}
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, message in reader.iter_messages():
            counts[channel.topic] = counts.get(channel.topic, 0) + 1
            assert message.data
    assert counts == dict(flight.offered)


def test_players_schemas_are_foxgloves_and_ours_have_names(flown: tuple[Path, Flight]) -> None:
    with flown[0].open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    schemas = {channel.topic: summary.schemas[channel.schema_id].name for channel in summary.channels.values()}
    assert schemas["/tf"] == "foxglove.FrameTransforms"
    assert schemas["/drone/1/pose"] == "foxglove.PoseInFrame"
    assert schemas["/drone/1/camera"] == "foxglove.CompressedImage"
    assert schemas["/drone/1/calibration"] == "foxglove.CameraCalibration"
    assert schemas["/map"] == "foxglove.SceneUpdate"
    assert schemas["/map/free"] == "foxglove.PointCloud"
    assert schemas["/log"] == "foxglove.Log"
    assert schemas["/drone/1/state"] == "covrecon.DroneState"
    assert schemas["/phi/jump"] == "covrecon.Jump"


def test_foxgloves_messages_can_be_decoded(flown: tuple[Path, Flight]) -> None:
    path, flight = flown
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        wanted = ["/tf", "/drone/1/camera", "/drone/1/calibration", "/log"]
        decoded: dict[str, Any] = {}
        for _, channel, _, content in reader.iter_decoded_messages(wanted):
            decoded.setdefault(channel.topic, content)
    assert [transform.child_frame_id for transform in decoded["/tf"].transforms] == ["drone_1", "camera_1"]
    assert decoded["/drone/1/camera"].data == flight.keyframes[0].jpeg
    assert decoded["/drone/1/calibration"].K[0] == flight.keyframes[0].fx
    assert decoded["/log"].message == "mode: tick 0"


def test_inputs_come_back_in_order_and_to_the_last_bit(flown: tuple[Path, Flight]) -> None:
    path, flight = flown
    found = list(Recording.open(path).inputs())
    assert len(found) == len(flight.inputs)
    for entry, given in zip(found, flight.inputs, strict=True):
        match entry:
            case HandOver():
                assert (entry.keyframes, entry.missing) == (given, ())
            case Look():
                assert entry.importance == given
            case IntegratedTick():
                assert isinstance(given, Integrated)
                assert (entry.tick, list(entry.ids)) == (given.tick, given.ids)
                assert entry.poses.tobytes() == given.poses.tobytes()
            case JumpRecord(jump=jump):
                assert isinstance(given, messages.Jump)
                assert (jump.epoch, jump.sequence, jump.tick) == (given.epoch, given.sequence, given.tick)
                assert jump.increments.tobytes() == given.increments.tobytes()
                assert entry.look == given.tick - 20


def test_depth_comes_back_beside_its_own_keyframe_alone(tmp_path: Path) -> None:
    random = np.random.default_rng(5)
    plain = [keyframe(1, number, 10 * number, random=random) for number in range(6)]
    taken = [one.model_copy(update={"depth": random.bytes(300)}) if one.sequence % 2 else one for one in plain]
    with Recorder(tmp_path / "depth.mcap", team(1), lossless=True) as recorder:
        for one in taken:
            recorder.heard(topics.KEYFRAME, one, one.tick)
    recording = Recording.open(tmp_path / "depth.mcap")
    assert list(recording.keyframes()) == taken
    assert (recording.counts()["/drone/1/depth"], recording.losses()) == (3, {})


def test_what_people_see_comes_back_as_well(flown: tuple[Path, Flight]) -> None:
    path, flight = flown
    recording = Recording.open(path)
    mesh = flight.meshes[-1]
    assert recording.mission == flight.mission
    assert recording.lossless
    assert not recording.resumed
    assert recording.complete
    assert list(recording.keyframes()) == flight.keyframes
    assert list(recording.states(2)) == [told for told in flight.states if told.drone == 2]
    assert [event.text for event in recording.events()] == [f"tick {tick}" for tick in range(TICKS)]
    assert [row["tick"] for row in recording.metrics()] == list(range(TICKS))
    assert (recording.summary() or {})["exit_reason"] == "enough"
    assert recording.counts() == dict(flight.offered)
    assert recording.losses() == {}
    assert list(recording.meshes()) == [(TICKS, glb(mesh.vertices, mesh.faces, mesh.colors))]
    assert recording.final_mesh_ply() == ply(mesh.vertices, mesh.faces, mesh.colors)


def test_iterators_may_be_left_before_their_end(flown: tuple[Path, Flight]) -> None:
    recording = Recording.open(flown[0])
    first = next(iter(recording.inputs()))
    assert isinstance(first, IntegratedTick)
    assert next(iter(recording.states(1))).tick == 0


def test_maps_free_space_and_phi_are_recorded_once_a_period(tmp_path: Path) -> None:
    mission = team()
    random = np.random.default_rng(1)
    phi = random.random(VirtualField.of(mission.target).shape, dtype=np.float32)
    mean = phi.mean(axis=1)
    grid = ObstacleGrid.of(mission)
    period = round(mission.recording.mesh_period_s / mission.tick_s)
    with Recorder(tmp_path / "a.mcap", mission, lossless=True) as recorder:
        for tick in range(100, 100 + 2 * period + 1):
            recorder.phi(tick, phi)
            recorder.mesh(tick, a_mesh(random))
            recorder.free(tick, grid, grid.vouched)
        phi[:] = 0  # the caller goes on with it
    recording = Recording.open(tmp_path / "a.mcap")
    assert recording.counts()["/map/free"] == 3
    assert [tick for tick, _ in recording.meshes()] == [100, 100 + period, 100 + 2 * period]
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        clouds = [content for *_, content in reader.iter_decoded_messages(["/phi"])]
    assert len(clouds) == 3
    values = np.frombuffer(clouds[0].data, np.dtype("<f4")).reshape(-1, clouds[0].point_stride // 4)
    np.testing.assert_allclose(values[:, -1], mean, atol=1e-6)


def test_a_map_without_triangles_is_not_recorded(tmp_path: Path) -> None:
    with Recorder(tmp_path / "a.mcap", team(), lossless=True) as recorder:
        recorder.mesh(0, a_mesh(np.random.default_rng(1), triangles=0))
    assert list(Recording.open(tmp_path / "a.mcap").meshes()) == []


def test_the_phase_is_recorded_when_it_changes(tmp_path: Path) -> None:
    phases = [messages.MissionPhase(phase=phase, reason="") for phase in ("starting", "starting", "flying")]
    with Recorder(tmp_path / "a.mcap", team(), lossless=True) as recorder:
        for phase in phases:
            recorder.heard(topics.PHASE, phase, 0)
    assert Recording.open(tmp_path / "a.mcap").counts()["/ground/phase"] == 2


def test_a_drone_that_is_not_in_the_mission_is_left_out(tmp_path: Path) -> None:
    random = np.random.default_rng(1)
    with Recorder(tmp_path / "a.mcap", team(), lossless=True) as recorder:
        recorder.heard(topics.STATE, state(9, 0, random=random), 0)
        recorder.heard(topics.KEYFRAME, keyframe(9, 0, 0, random=random), 0)
    assert set(Recording.open(tmp_path / "a.mcap").counts()) == {"/mission"}


def held_up(recorder: Recorder, monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """From now on the disk takes nothing until the event is set."""
    go_on = threading.Event()
    write: Callable[..., None] = recorder._writer.write

    def wait(*entry: Any) -> None:
        assert go_on.wait(10)
        write(*entry)

    monkeypatch.setattr(recorder._writer, "write", wait)
    return go_on


def test_in_real_time_what_the_disk_has_no_time_for_is_dropped_and_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flight = Flight(short_of_room())
    with Recorder(tmp_path / "a.mcap", flight.mission, lossless=False) as recorder:
        go_on = held_up(recorder, monkeypatch)
        flight.fly(recorder, range(50))
        assert recorder.statistics().worst_stall_s < 1
        go_on.set()
    statistics = recorder.statistics()
    counts = Recording.open(tmp_path / "a.mcap").counts()
    assert statistics.dropped["/drone/1/state"] > 20
    for channel, written in statistics.written.items():
        assert written == counts.get(channel, 0) == flight.offered[channel] - statistics.dropped[channel]
    losses = {channel: count for channel, count in statistics.dropped.items() if count}
    assert Recording.open(tmp_path / "a.mcap").losses() == losses


def test_keyframes_that_were_dropped_are_missing_where_they_were_handed_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    random = np.random.default_rng(1)
    keyframes = [keyframe(1, number, number, random=random) for number in range(40)]
    recorder = Recorder(tmp_path / "a.mcap", short_of_room(), lossless=False)
    go_on = held_up(recorder, monkeypatch)
    for taken in keyframes:
        recorder.heard(topics.KEYFRAME, taken, taken.tick)
    go_on.set()
    while recorder.statistics().queue:
        threading.Event().wait(0.001)
    recorder.handed_over(40, keyframes)
    recorder.close()
    (found,) = Recording.open(tmp_path / "a.mcap").inputs()
    assert isinstance(found, HandOver)
    assert 15 <= len(found.keyframes) <= 17  # the queue, and what the writer had taken from it
    assert found.keyframes == tuple(keyframes[: len(found.keyframes)])
    assert found.missing == tuple((1, number) for number in range(len(found.keyframes), 40))


def test_in_lockstep_the_flight_waits_for_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flight = Flight(short_of_room())
    with Recorder(tmp_path / "a.mcap", flight.mission, lossless=True) as recorder:
        go_on = held_up(recorder, monkeypatch)
        flying = threading.Thread(target=flight.fly, args=(recorder, range(50)))
        flying.start()
        flying.join(0.2)
        assert flying.is_alive()
        go_on.set()
        flying.join(10)
    assert Recording.open(tmp_path / "a.mcap").counts() == dict(flight.offered)


def test_a_full_disk_ends_the_recording_and_not_the_flight(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    flight = Flight(team())
    with Recorder(tmp_path / "a.mcap", flight.mission, lossless=True) as recorder:
        file = recorder._writer._file
        assert file is not None
        file._file = FullDisk(file._file, 100_000, 3000)  # type: ignore[assignment]
        flight.fly(recorder, range(200))
        flight.finish(recorder, 200)
    statistics = recorder.statistics()
    assert statistics.failed.endswith("No space left on device")
    assert statistics.bytes <= 100_000
    for channel, count in flight.offered.items():
        assert statistics.written[channel] + statistics.dropped[channel] == count
    assert [record.message for record in caplog.records if record.levelname == "ERROR"] == [
        f"{tmp_path / 'a.mcap'}: No space left on device; the flight goes on unrecorded"
    ]
    recording = Recording.open(tmp_path / "a.mcap", salvage=True)
    assert 0 < recording.counts()["/ground/integrated"] <= statistics.written["/ground/integrated"]


def test_what_cannot_be_written_ends_the_recording_and_not_the_flight(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    mesh = a_mesh(np.random.default_rng(1))
    with Recorder(tmp_path / "a.mcap", team(), lossless=True) as recorder:
        recorder.heard(topics.EVENT, messages.Event(source="ground", tick=0, level="info", kind="a", text=""), 0)
        recorder.mesh(0, mesh.__class__(mesh.vertices[:, :1], mesh.faces, mesh.colors))
        recorder.heard(topics.EVENT, messages.Event(source="ground", tick=0, level="info", kind="a", text=""), 0)
    statistics = recorder.statistics()
    assert statistics.failed == "internal error"
    assert "Traceback" in caplog.text
    assert (statistics.written["/log"], statistics.dropped["/log"]) == (1, 1)


def test_after_its_end_nothing_is_recorded_and_all_is_counted(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "a.mcap", team(), lossless=True)
    recorder.close()
    recorder.close()
    recorder.looked(0, 0.5)
    assert recorder.statistics().dropped["/ground/look"] == 1


def test_without_a_file_and_without_a_watcher_nothing_happens(tmp_path: Path) -> None:
    with Recorder(None, team(), lossless=False) as recorder:
        recorder.looked(0, 0.5)
    assert recorder.statistics().written["/ground/look"] == 0
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_exists_is_never_written_over(tmp_path: Path) -> None:
    path = tmp_path / "recording.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(StorageError, match=r"recording\.mcap: File exists"):
        Recorder(path, team(), lossless=False)
    assert recording_path(tmp_path) == tmp_path / "recording-2.mcap"
    (tmp_path / "recording-2.mcap").touch()
    assert recording_path(tmp_path) == tmp_path / "recording-3.mcap"


def test_log_times_are_the_clocks_at_the_start_and_mission_time_from_then_on(flown: tuple[Path, Flight]) -> None:
    path, flight = flown
    epoch_ns = Recording.open(path).epoch_ns
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages(["/drone/1/state", "/ground/integrated"]):
            tick = json.loads(message.data)["tick"]
            assert message.log_time == epoch_ns + round(tick * flight.mission.tick_s * 1e9), channel.topic
