"""``covrecon export``: what it writes where, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import pytest

from deploy.export_command import export_app
from faults.flown import Flown, a_flight, write_folder, write_recording
from protocol.errors import CovreconError, StorageError

EXPORTS = {
    "nerfstudio": "transforms.json",
    "colmap": "sparse/0/images.txt",
    "mesh": "mesh.obj",
    "cloud": "cloud.ply",
    "trajectories": "drone_1.tum",
    "phi": "importance.vtk",
}


@pytest.fixture(scope="module")
def flown() -> Flown:
    return a_flight()


@pytest.fixture
def run(flown: Flown, tmp_path: Path) -> Path:
    return write_folder(flown, tmp_path / "run")


def export(*arguments: object) -> None:
    export_app([str(argument) for argument in arguments], result_action="return_value")


@pytest.mark.parametrize(("name", "file"), EXPORTS.items())
def test_every_export_goes_into_the_run_s_folder_and_is_told(
    run: Path, name: str, file: str, capsys: pytest.CaptureFixture[str]
) -> None:
    export(name, run)
    assert (run / "export" / name / file).is_file()
    assert capsys.readouterr().out.endswith(f": {run / 'export' / name}\n")


def test_a_recording_is_exported_beside_it(flown: Flown, tmp_path: Path) -> None:
    export("trajectories", write_recording(flown, tmp_path / "recording-2.mcap"))
    assert (tmp_path / "recording-2-export/trajectories/trajectories.csv").is_file()


def test_formats_and_counts_can_be_chosen(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    export("mesh", run, "--format", "glb", "--out", out)
    export("cloud", run, "--points", 10, "--out", out, "--force")
    assert sorted(file.name for file in out.iterdir()) == ["cloud.ply", "mesh.glb"]
    assert b"element vertex 10\n" in (out / "cloud.ply").read_bytes()


def test_a_folder_that_holds_something_is_refused_unless_forced(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "thesis.tex").write_text("years of work")
    with pytest.raises(CovreconError, match=r"out: is not empty; .*--force"):
        export("mesh", run, "--out", out)
    export("mesh", run, "--out", out, "--force")
    assert (out / "thesis.tex").read_text() == "years of work"
    assert (out / "mesh.ply").is_file()


def test_a_file_in_place_of_the_folder_is_refused(run: Path, tmp_path: Path) -> None:
    file = tmp_path / "out"
    file.write_text("")
    with pytest.raises(CovreconError, match="is a file"):
        export("mesh", run, "--out", file, "--force")


def test_what_the_disk_refuses_is_told_with_its_name(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / "mesh.ply").mkdir(parents=True)
    with pytest.raises(StorageError, match=r"mesh\.ply: Is a directory"):
        export("mesh", run, "--out", out, "--force")


def test_an_export_that_fails_leaves_no_empty_transforms_behind(run: Path, tmp_path: Path) -> None:
    (run / "keyframes").unlink()
    with pytest.raises(CovreconError, match="no keyframes"):
        export("nerfstudio", run, "--out", tmp_path / "out")
    assert not (tmp_path / "out/transforms.json").exists()


def test_every_command_has_an_example_and_says_what_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    for name in EXPORTS:
        export(name, "--help")
        assert f"covrecon export {name}" in capsys.readouterr().out
