"""What exports are made from: a run's folder in any state, and a recording, which gives the same."""

from __future__ import annotations

import dataclasses
import filecmp
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from faults.flown import KEYFRAME_TICKS, ORIGIN, TICKS, Flown, a_flight, write_folder, write_recording
from ground_station.checkpoint import CHECKPOINT_FILE
from ground_station.export.colmap import export_colmap
from ground_station.export.flights import export_flight
from ground_station.export.importance_files import export_importance
from ground_station.export.maps import export_cloud, export_mesh
from ground_station.export.nerfstudio import export_nerfstudio
from ground_station.export.output import Exported
from ground_station.export.source import Source, open_source
from protocol.errors import CovreconError, MissionError, RecordingError

EXPORTS: dict[str, Callable[[Source, Path], Exported]] = {
    "colmap": lambda source, folder: export_colmap(source, folder, points=100),
    "nerfstudio": lambda source, folder: export_nerfstudio(source, folder, points=100),
    "mesh": lambda source, folder: export_mesh(source, folder, ("ply", "glb", "obj")),
    "cloud": lambda source, folder: export_cloud(source, folder, 100),
    "trajectories": lambda source, folder: export_flight(source, folder, ("csv", "tum")),
    "phi": lambda source, folder: export_importance(source, folder, ("npz",)),
}


@pytest.fixture(scope="module")
def flown() -> Flown:
    return a_flight(ORIGIN)


@pytest.fixture
def run(flown: Flown, tmp_path: Path) -> Path:
    return write_folder(flown, tmp_path / "run")


@pytest.fixture
def cut_short(flown: Flown, tmp_path: Path) -> Path:
    return write_folder(flown, tmp_path / "cut", finished=False)


@pytest.mark.parametrize("name", EXPORTS)
def test_a_recording_gives_the_same_files_as_the_run_s_folder(
    name: str, run: Path, flown: Flown, tmp_path: Path
) -> None:
    recording = write_recording(flown, tmp_path / "recording.mcap")
    folders = tmp_path / "of_run", tmp_path / "of_recording"
    for path, folder in zip((run, recording), folders, strict=True):
        folder.mkdir()
        EXPORTS[name](open_source(path), folder)
    files = [str(file.relative_to(folders[0])) for file in folders[0].rglob("*") if file.is_file()]
    same, other, failed = filecmp.cmpfiles(*folders, files, shallow=False)
    assert files
    assert (sorted(same), other, failed) == (sorted(files), [], [])


def test_nothing_in_a_run_s_folder_changes(run: Path, tmp_path: Path) -> None:
    with (run / "keyframes").open("ab") as file:
        file.write(b"torn")
    before = {file.name: (file.read_bytes(), file.stat().st_mtime_ns) for file in run.iterdir()}
    for name, export in EXPORTS.items():
        folder = tmp_path / name
        folder.mkdir()
        export(open_source(run), folder)
    assert {file.name: (file.read_bytes(), file.stat().st_mtime_ns) for file in run.iterdir()} == before


def test_keyframes_before_a_torn_end_are_read(run: Path, flown: Flown) -> None:
    file = run / "keyframes"
    os.truncate(file, file.stat().st_size - 10)
    assert list(open_source(run).keyframes()) == list(flown.keyframes[:-1])


def test_damaged_keyframes_are_told_and_left_out(run: Path, flown: Flown, caplog: pytest.LogCaptureFixture) -> None:
    file = run / "keyframes"
    content = bytearray(file.read_bytes())
    content[100] ^= 1
    file.write_bytes(content)
    assert list(open_source(run).keyframes()) == list(flown.keyframes[1:])
    assert "bytes 0 to" in caplog.text


def test_progress_is_told(run: Path, flown: Flown) -> None:
    told: list[tuple[str, int, int]] = []
    list(open_source(run, lambda *step: told.append(step)).keyframes())
    count = len(flown.keyframes)
    assert told == [("keyframes", number, count) for number in range(1, count + 1)]


@pytest.mark.parametrize("content", [None, b"", b"nothing of ours"])
def test_a_run_without_keyframes_says_so(run: Path, tmp_path: Path, content: bytes | None) -> None:
    file = run / "keyframes"
    file.unlink()
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(CovreconError, match="keyframe"):
        export_colmap(open_source(run), tmp_path, points=0)


def test_a_run_that_was_cut_short_has_no_map_but_says_where_to_look(cut_short: Path) -> None:
    with pytest.raises(CovreconError, match=r"mesh\.ply: no map.*recording"):
        open_source(cut_short).mesh()


def test_phi_of_a_run_that_was_cut_short_is_that_of_the_checkpoint(cut_short: Path, flown: Flown) -> None:
    importance = open_source(cut_short).importance()
    np.testing.assert_array_equal(importance.phi, flown.phi)
    assert importance.moment == "after 3 s, from checkpoint"


def test_a_damaged_checkpoint_gives_way_to_the_one_before_and_stays_where_it_is(cut_short: Path) -> None:
    newest = cut_short / CHECKPOINT_FILE
    content = newest.read_bytes()
    (cut_short / "checkpoint.previous").write_bytes(content)
    newest.write_bytes(content[:-1])
    importance = open_source(cut_short).importance()
    assert importance.moment == "after 3 s, from checkpoint.previous"
    assert newest.read_bytes() == content[:-1]
    (cut_short / "checkpoint.previous").unlink()
    with pytest.raises(CovreconError, match="nor a checkpoint that is whole"):
        open_source(cut_short).importance()


def test_phi_of_another_shape_is_refused(run: Path, flown: Flown) -> None:
    np.savez(run / "phi.npz", phi=flown.phi[1:])
    with pytest.raises(CovreconError, match=r"phi\.npz: phi is float32"):
        open_source(run).importance()


@pytest.mark.parametrize(
    ("file", "part"),
    [
        ("trajectories.npz", lambda source: source.flight()),
        ("phi.npz", lambda source: source.importance()),
        ("mesh.ply", lambda source: source.mesh()),
    ],
)
@pytest.mark.parametrize("content", [b"", b"nothing of ours", None])
def test_damaged_files_are_named(run: Path, file: str, part: Callable[[Source], object], content: bytes | None) -> None:
    whole = (run / file).read_bytes()
    (run / file).write_bytes(whole[: len(whole) // 2] if content is None else content)
    with pytest.raises(CovreconError, match=file.replace(".", r"\.")):
        part(open_source(run))


def test_no_trajectories_are_told(run: Path) -> None:
    (run / "trajectories.npz").unlink()
    with pytest.raises(CovreconError, match="no trajectories yet"):
        open_source(run).flight()


def test_a_folder_that_is_no_run_s_is_told(tmp_path: Path) -> None:
    with pytest.raises(MissionError, match="is this the folder of a run"):
        open_source(tmp_path)


@pytest.mark.parametrize("content", [None, b"", b"nothing of ours"])
def test_what_is_no_recording_is_told(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "some.mcap"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"some\.mcap"):
        open_source(path)


def test_a_recording_that_was_cut_short_gives_what_is_whole(
    flown: Flown, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_recording(flown, tmp_path / "recording.mcap", finished=False)
    os.truncate(path, path.stat().st_size - 100)
    source = open_source(path)
    assert "end is not in it" in caplog.text
    assert source.flight().tick.tolist()
    assert source.importance().moment == f"after {TICKS / 20:g} s"
    np.testing.assert_array_equal(source.mesh().faces, flown.mesh.faces)
    np.testing.assert_allclose(source.mesh().vertices, flown.mesh.vertices, atol=1e-6)


def test_phi_of_a_recording_that_begins_late_is_refused(flown: Flown, tmp_path: Path) -> None:
    late = dataclasses.replace(
        flown,
        states={tick: states for tick, states in flown.states.items() if tick >= KEYFRAME_TICKS},
        keyframes=flown.keyframes[2:],
    )
    source = open_source(write_recording(late, tmp_path / "recording-2.mcap"))
    with pytest.raises(RecordingError, match=f"begins at tick {KEYFRAME_TICKS}"):
        source.importance()


def test_phi_of_a_recording_with_a_gap_is_refused(flown: Flown, tmp_path: Path) -> None:
    gap = dataclasses.replace(flown, states={tick: states for tick, states in flown.states.items() if tick != 5})
    source = open_source(write_recording(gap, tmp_path / "recording.mcap"))
    with pytest.raises(RecordingError, match="ticks are missing at tick 6"):
        source.importance()
