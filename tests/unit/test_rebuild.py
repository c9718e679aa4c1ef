"""Maps made anew from the keyframes that a flight kept: with other settings, of a recording, and not at all."""

from __future__ import annotations

import json
from pathlib import Path
from typing import get_args, get_type_hints

import numpy as np
import pytest
import trimesh

from deploy.reconstruct_command import reconstruct
from faults.floor_flight import LEG, MISSION, write_run
from faults.flown import a_flight, write_recording
from ground_station.keyframe_log import KEYFRAMES_FILE
from ground_station.mesh_files import read_geometry
from ground_station.rebuild.__main__ import main
from ground_station.rebuild.quality import QUALITIES, Quality
from ground_station.rebuild.run import rebuilding_mission
from ground_station.results import MISSION_FILE
from protocol.errors import MissionError, ReconstructionError
from protocol.map_settings import Reconstruction
from protocol.mission import Target

QUICK = ("--set", "reconstruction.voxel_m=0.05", "--set", "reconstruction.sweep_width_px=96")


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run's folder of `FLIGHT` over a true floor."""
    write_run(tmp_path)
    return tmp_path


def test_a_map_is_made_anew_with_colour_and_scored_where_the_truth_is_known(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    figures = run / "figures.json"
    assert main([str(run), "--quality", "fast", "--figures", str(figures), *QUICK]) == 0
    out = capsys.readouterr().out
    assert f"from {LEG} keyframes" in out
    assert "F of a bare floor" in out
    told = json.loads(figures.read_text())
    assert told["visible"]["precision"] > 0.95
    assert (told["keyframes"], told["triangles"] > 500, told["cpu_ms_per_keyframe"] > 0) == (LEG, True, True)
    found = trimesh.load_mesh(run / "rebuilt.ply", process=False)
    assert np.ptp(found.visual.vertex_colors[:, :3].astype(int), axis=0).min() > 50


def test_a_finer_voxel_makes_more_triangles_and_a_name_s_end_says_the_format(run: Path) -> None:
    coarse, fine = run / "coarse.ply", run / "fine.glb"
    assert main([str(run), "--quality", "flown", "--out", str(coarse), *QUICK]) == 0
    assert (
        main([str(run), "--quality", "flown", "--out", str(fine), *QUICK, "--set", "reconstruction.voxel_m=0.025"]) == 0
    )
    triangles = [len(read_geometry(path)[1]) for path in (coarse, fine)]
    assert triangles[1] > 3 * triangles[0] > 0
    assert np.abs(read_geometry(fine)[0][:, 2]).max() < 0.1  # z is up in both


def test_every_quality_is_a_mission_that_can_be() -> None:
    for quality, settings in QUALITIES.items():
        mission = rebuilding_mission(MISSION, quality)
        assert mission.feedback.method == "none"
        for name, value in settings.items():
            assert getattr(mission.reconstruction, name) == value
    flown = MISSION.model_copy(update={"reconstruction": Reconstruction(backend="none")})
    assert rebuilding_mission(flown, "flown").reconstruction.backend == "plane_sweep"
    assert rebuilding_mission(MISSION, "high", settings=["reconstruction.voxel_m=0.03"]).reconstruction.voxel_m == 0.03
    with pytest.raises(MissionError, match="backend"):
        rebuilding_mission(MISSION, "flown", backend="guesswork")


def test_a_recording_will_do_as_well(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = write_recording(a_flight(), tmp_path / "flight.mcap")
    assert main([str(file), "--quality", "flown"]) == 1  # its images show one spot
    assert "no surface was found: 10 of 12 keyframes blurred" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "said"),
    [(None, "no keyframes were kept in this run"), (b"", "no keyframe was kept")],
    ids=["no file", "nothing in it"],
)
def test_a_run_without_keyframes_is_told_so(
    run: Path, content: bytes | None, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (run / KEYFRAMES_FILE).unlink()
    if content is not None:
        (run / KEYFRAMES_FILE).write_bytes(content)
    assert main([str(run)]) == 1
    assert said in capsys.readouterr().err
    assert not (run / "rebuilt.ply").exists()


@pytest.mark.parametrize(
    ("options", "said", "code"),
    [
        (("--set", "camera.width_px=640"), "is flown already", 2),
        (("--backend", "guesswork"), "reconstruction.backend", 2),
        (("--out", "map.stl"), "a mesh is written as .ply or .glb", 1),
    ],
)
def test_wishes_that_cannot_be_are_refused_before_the_work(
    run: Path, options: tuple[str, ...], said: str, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(run), *options]) == code
    assert said in capsys.readouterr().err


def test_a_map_that_does_not_fit_in_memory_is_refused_before_it_begins(tmp_path: Path) -> None:
    field = MISSION.model_copy(update={"target": Target(lower_m=(-60, -60, 0), upper_m=(60, 60, 20))})
    (tmp_path / MISSION_FILE).write_text(field.model_dump_json())
    with pytest.raises(ReconstructionError, match=r"voxel_m 0.015: takes about 10\d\d.* GB of memory.*larger voxel"):
        reconstruct(tmp_path)


def test_the_command_offers_every_quality_there_is() -> None:
    offered = get_args(get_type_hints(reconstruct)["quality"])
    assert set(offered) == set(get_args(Quality)) == set(QUALITIES)
