from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from faults.disk import in_child
from faults.recorded import Flight, team
from ground_station.recording.description import describe
from ground_station.recording.entries import HandOver, IntegratedTick
from ground_station.recording.mcap_file import Salvage
from ground_station.recording.reader import Recording
from ground_station.recording.recorder import Recorder
from ground_station.recording.repair import repair
from protocol.errors import RecordingError

TICKS = 200


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "recording.mcap"
    flight = Flight(team())
    with Recorder(path, flight.mission, lossless=True) as recorder:
        flight.fly(recorder, range(TICKS))
        flight.finish(recorder, TICKS)
    return path


def cut(path: Path, size: int, folder: Path) -> Path:
    torn = folder / "torn.mcap"
    torn.write_bytes(path.read_bytes()[:size])
    return torn


def write_mcap(path: Path, missions: list[dict[str, object]]) -> Path:
    """A file of somebody else's."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/mission", "json", 0)
        for mission in missions:
            writer.add_message(channel, 0, json.dumps(mission).encode(), 0)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def test_what_is_no_recording_is_refused_with_the_reason(whole: Path, tmp_path: Path) -> None:
    text = tmp_path / "text.mcap"
    text.write_text("hello")
    stranger = write_mcap(tmp_path / "stranger.mcap", [])
    later = write_mcap(tmp_path / "later.mcap", [{"version": 2}])
    other = {"version": 1, "resumed": False, "lossless": True, "epoch_ns": 0, "mission": {"name": "a", "drones": "b"}}
    faulty = write_mcap(tmp_path / "faulty.mcap", [other])
    torn = cut(whole, whole.stat().st_size // 2, tmp_path)
    for path, reason in [
        (tmp_path / "missing.mcap", "missing.mcap: No such file or directory"),
        (tmp_path, "Is a directory"),
        (text, "text.mcap: not an MCAP file"),
        (stranger, "holds no mission"),
        (later, "recording of version 2, this program reads 1"),
        (faulty, "mission is not this version's: drones"),
        (torn, "cut short; 'covrecon recording repair .*torn.mcap' recovers what is whole"),
    ]:
        with pytest.raises(RecordingError, match=reason):
            Recording.open(path)


def test_of_a_recording_cut_anywhere_all_that_is_whole_comes_back(whole: Path, tmp_path: Path) -> None:
    size = whole.stat().st_size
    original = list(Recording.open(whole).inputs())
    before = 0
    for part in range(1, 20):
        torn = cut(whole, size * part // 20, tmp_path)
        target = tmp_path / f"{part}.mcap"
        found = repair(torn, target)
        recovered = list(Recording.open(target).inputs())
        salvaged = list(Recording.open(torn, salvage=True).inputs())
        assert len(recovered) == len(salvaged) >= before
        for entry, first in zip(recovered, original, strict=False):
            assert type(entry) is type(first)
            if isinstance(entry, IntegratedTick) and isinstance(first, IntegratedTick):
                assert entry.poses.tobytes() == first.poses.tobytes()
            if isinstance(entry, HandOver) and isinstance(first, HandOver):
                assert entry.keyframes == first.keyframes
        assert found.messages == sum(Recording.open(target).counts().values())
        assert found.lost_bytes < 70_000
        before = len(recovered)
    assert before > len(original) // 2


def test_a_repaired_recording_is_one_that_any_reader_takes(whole: Path, tmp_path: Path) -> None:
    target = tmp_path / "target.mcap"
    repair(cut(whole, whole.stat().st_size * 2 // 3, tmp_path), target)
    with target.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert sum(1 for _ in reader.iter_messages()) == summary.statistics.message_count > 500
    assert not Recording.open(target).complete
    assert Recording.open(target).summary() is None


def test_a_chunk_that_is_damaged_costs_that_chunk_alone(whole: Path, tmp_path: Path) -> None:
    content = bytearray(whole.read_bytes())
    with whole.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    chunks = sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset)
    chunk = chunks[len(chunks) // 2]
    content[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 0xFF
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(content)
    with pytest.raises(RecordingError, match=r"damaged: .*covrecon recording repair"):
        list(Recording.open(damaged).inputs())
    found = repair(damaged, tmp_path / "target.mcap")
    recording = Recording.open(tmp_path / "target.mcap")
    counts, original = recording.counts(), Recording.open(whole).counts()
    assert found.lost_bytes == chunk.chunk_length
    assert recording.complete
    assert original["/ground/integrated"] > counts["/ground/integrated"] > TICKS // 2
    assert recording.final_mesh_ply() == Recording.open(whole).final_mesh_ply()
    assert len(list(recording.keyframes())) <= counts["/drone/1/keyframe"] + counts["/drone/2/keyframe"]


def test_a_whole_recording_loses_nothing_when_it_is_repaired(whole: Path, tmp_path: Path) -> None:
    found = repair(whole, tmp_path / "target.mcap")
    assert found.lost_bytes == 0
    assert found.duration_s == pytest.approx(TICKS * 0.05)
    assert Recording.open(tmp_path / "target.mcap").counts() == Recording.open(whole).counts()


def test_repair_writes_nothing_when_there_is_nothing_to_write(whole: Path, tmp_path: Path) -> None:
    text = tmp_path / "text.mcap"
    text.write_text("hello")
    for source, target, reason in [
        (text, tmp_path / "a.mcap", "not an MCAP file"),
        (tmp_path / "missing.mcap", tmp_path / "a.mcap", "No such file"),
        (cut(whole, 300, tmp_path), tmp_path / "a.mcap", "holds nothing that can be recovered"),
        (whole, text, "text.mcap: exists already"),
        (whole, tmp_path / "nowhere" / "a.mcap", "No such file"),
    ]:
        with pytest.raises(RecordingError, match=reason):
            repair(source, target)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["text.mcap", "torn.mcap"]


def test_a_disk_that_fills_up_during_the_repair_keeps_no_half_of_it(whole: Path, tmp_path: Path) -> None:
    def attempt() -> None:
        with pytest.raises(RecordingError, match="File too large"):
            repair(whole, tmp_path / "target.mcap")

    assert in_child(attempt, largest_file=50_000) == 0
    assert list(tmp_path.iterdir()) == []


def test_lengths_that_damage_made_up_cost_no_memory(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    huge = (2**60).to_bytes(8, "little")
    chunk = bytes(16) + huge + bytes(4) + (4).to_bytes(4, "little") + b"zstd" + huge
    path.write_bytes(b"\x89MCAP0\r\n" + b"\x06" + len(chunk).to_bytes(8, "little") + chunk + b"\x06" + huge)
    salvage = Salvage(path)
    assert list(salvage.contents()) == []
    assert salvage.lost_bytes == path.stat().st_size - 8


def test_a_recording_is_described_whole_or_torn(whole: Path, tmp_path: Path) -> None:
    text = describe(whole)
    assert "mission: recorded, drones: 2, in lockstep" in text
    assert f"flown: {(TICKS - 1) * 0.05:.1f} s, enough" in text
    assert re.search(rf"/ground/integrated +{TICKS} +0$", text, re.MULTILINE)
    torn = cut(whole, whole.stat().st_size // 2, tmp_path)
    assert f"cut short: 'covrecon recording repair {torn}' makes it whole" in describe(torn)
    repair(torn, tmp_path / "target.mcap")
    assert "the end is not in it" in describe(tmp_path / "target.mcap")
