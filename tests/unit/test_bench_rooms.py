"""The random-room suite: which flights and maps it is made of, the maps that are made, and what its page says."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest

from deploy.bench.maps import make_maps, maps_left
from deploy.bench.plan import Wish, plan_of
from deploy.bench.progress import PlainWatch, Tally
from deploy.bench.rooms import COVERED, FIRST_ROOM, MapJob, map_jobs, room_jobs
from faults.floor_flight import LEG, write_run
from ground_station.mesh_files import ply
from ground_station.results import MESH_PLY_FILE, MISSION_FILE
from ground_station.study.document import put_into, write_study
from ground_station.study.mapped import FLOOR, level_rows, load_mapped
from ground_station.study.plan_file import FIGURES_FILE, FLIGHTS_FOLDER, MAPS_FOLDER, read_plan, write_plan
from protocol.errors import CovreconError, MissionError
from protocol.guard import ROOT

PAPER = ROOT / "missions" / "paper.toml"
WAYS = ("plane_sweep", "plane_sweep:high", "learned")
CONTRASTS = (1.0, 0.25)
SQUARE = np.array([(-3, -3, 0), (3, -3, 0), (3, 3, 0), (-3, 3, 0)], np.float32)
HALVES = np.array([(0, 1, 2), (0, 2, 3)], np.int32)


def wish(rooms: int = 2, **settings: object) -> Wish:
    return Wish(PAPER, 300.0, rooms, {name.replace("__", "."): value for name, value in settings.items()})


def test_each_room_is_flown_once_under_each_texture_until_it_is_covered() -> None:
    jobs = room_jobs(wish(), CONTRASTS)
    assert [(job.planned.scene, job.planned.contrast) for job in jobs] == [
        (f"room-{room}", contrast) for room in (FIRST_ROOM, FIRST_ROOM + 1) for contrast in CONTRASTS
    ]
    assert len({job.planned.folder for job in jobs}) == len({job.planned.name for job in jobs}) == 4
    for job in jobs:
        assert (job.mission.stop_below, len(job.mission.drones)) == (COVERED, 4)
        assert (job.mission.feedback.method, job.mission.reconstruction.backend) == ("none", "none")
        assert job.mission.simulation.texture_contrast == job.planned.contrast


def test_settings_of_the_reconstruction_change_maps_and_leave_flights_as_they_are() -> None:
    plain, other = wish(), wish(reconstruction__voxel_m=0.02, reconstruction__workers=1)
    flights = room_jobs(plain, CONTRASTS)
    assert room_jobs(other, CONTRASTS) == flights
    assert room_jobs(wish(simulation__image_noise=4.0), CONTRASTS)[0].planned.key != flights[0].planned.key
    before, after = map_jobs(flights, WAYS, plain.settings), map_jobs(flights, WAYS, other.settings)
    assert not {job.planned.folder for job in before} & {job.planned.folder for job in after}
    assert after[0].settings == ("reconstruction.voxel_m=0.02", "reconstruction.workers=1")
    assert len({job.planned.folder for job in before}) == len(before) == len(flights) * len(WAYS)
    assert [(job.backend, job.quality) for job in before[:3]] == [
        ("plane_sweep", "flown"), ("plane_sweep", "high"), ("learned", "flown"),
    ]  # fmt: skip
    with pytest.raises(MissionError, match="plane_sweep:best: best is no quality; there are flown, fast, high"):
        map_jobs(flights, ["plane_sweep:best"], {})


@pytest.mark.processes
@pytest.mark.light
async def test_maps_are_made_of_what_is_flown_and_a_way_that_cannot_says_why(tmp_path: Path) -> None:
    flights = room_jobs(wish(rooms=1), CONTRASTS)
    write_run(tmp_path / FLIGHTS_FOLDER / flights[0].planned.folder)
    jobs = map_jobs(flights, ["plane_sweep:fast", "guesswork"], {"reconstruction.voxel_m": 0.05})
    left = maps_left(tmp_path, jobs)
    assert left == jobs[:2]  # the other texture is not flown
    said: list[str] = []
    tally = Tally({job.planned.name: 1.0 for job in left}, 0, len(left), words=("maps made", "being made"))
    assert await make_maps(tmp_path, left, 2, PlainWatch(tally, said.append)) == 0
    assert maps_left(tmp_path, jobs) == []
    assert "2 of 2 maps made, 0 being made" in said[-1]

    write_plan(tmp_path, plan_of("reconstruction", wish(), flights, "covrecon", [job.planned for job in jobs]))
    made, refused = load_mapped(tmp_path, read_plan(tmp_path))
    assert made.figures["keyframes"] == LEG
    assert made.figures["precision"] > 0.95
    assert made.floor["f_visible"] == pytest.approx(1.0, abs=0.01)
    assert (made.folder / MESH_PLY_FILE).stat().st_size > 0
    assert "reconstruction.backend" in refused.reason
    assert math.isnan(refused.figures["f_visible"])


def pretend(folder: Path, job: MapJob, f: float | None) -> None:
    """A map that was made, with F ``f`` of all surfaces; None: one that could not be."""
    place = folder / MAPS_FOLDER / job.planned.folder
    place.mkdir(parents=True)
    told: dict[str, object] = {"reason": "torch is not installed"}
    if f is not None:
        share = {"f": f, "precision": f, "recall": f}
        floor = {key: {"f": 0.5, "precision": 1.0, "recall": 0.3} for key in ("visible", "objects", "exposed")}
        told = {"visible": share, "objects": share, "exposed": share, "floor": floor}
        told |= {"chamfer_m": 0.03, "keyframes": 1700, "cpu_ms_per_keyframe": 20.0}
        (place / MESH_PLY_FILE).write_bytes(ply(SQUARE, HALVES, np.full((4, 3), (0, 150, 40), np.uint8)))
    (place / FIGURES_FILE).write_text(json.dumps(told))


@pytest.fixture
def suite(tmp_path: Path) -> Path:
    """Two rooms and two textures; F of plane_sweep 0.90 and 0.92, a tenth less under the weak one."""
    flights = room_jobs(wish(), CONTRASTS)
    jobs = map_jobs(flights, WAYS, {})
    for job in flights:
        (tmp_path / FLIGHTS_FOLDER / job.planned.folder).mkdir(parents=True)
        (tmp_path / FLIGHTS_FOLDER / job.planned.folder / MISSION_FILE).write_text(job.mission.model_dump_json())
    for each in jobs:
        flight = each.planned.flight
        good = 0.9 + 0.02 * (flight.seed - FIRST_ROOM) - (0.1 if flight.contrast < 1 else 0.0)
        pretend(tmp_path, each, None if each.backend == "learned" else good)
    write_plan(tmp_path, plan_of("reconstruction", wish(), flights, "covrecon", [job.planned for job in jobs]))
    return tmp_path


def test_rows_are_means_over_the_rooms_with_a_bare_floor_first(suite: Path) -> None:
    rows = level_rows(load_mapped(suite, read_plan(suite)))
    assert [(row.contrast, row.way) for row in rows] == [
        (contrast, way) for contrast in CONTRASTS for way in (FLOOR, *WAYS)
    ]
    spread = rows[1].spreads["f_visible"]
    assert (spread.mean, spread.known) == (pytest.approx(0.91), 2)
    assert rows[0].spreads["f_objects"].mean == 0.5
    assert rows[5].spreads["f_visible"].mean == pytest.approx(0.81)
    assert (rows[3].spreads["f_visible"].known, rows[3].reasons) == (0, ("torch is not installed",))


def test_page_tables_figure_and_picture_are_made_of_the_folder_alone(suite: Path, tmp_path: Path) -> None:
    text = write_study(suite).read_text()
    assert "12 of 12 maps of 4 flights" in text
    assert "| 100 % | `plane_sweep` | 0.910 ± 0.014 |" in text
    assert "| 25 % | a bare floor | 0.500 ± 0.000 |" in text
    assert "`learned` made no map of some rooms: torch is not installed" in text
    for name in ("levels.svg", "rooms.png"):
        assert (suite / name).stat().st_size > 0
        assert f"]({name})" in text
    rows = list(csv.DictReader((suite / "maps.csv").read_text().splitlines()))
    assert len(rows) == 12
    assert {row["reason"] for row in rows if row["way"] == "learned"} == {"torch is not installed"}
    assert float(rows[0]["f_visible"]) == 0.9
    told = json.loads((suite / "maps.json").read_text())
    assert (len(told["maps"]), len(told["levels"])) == (12, 8)

    page = tmp_path / "docs" / "reconstruction.md"
    page.parent.mkdir()
    page.write_text("before\n<!-- reconstruction -->\n<!-- /reconstruction -->\n")
    put_into(page, suite)
    assert "](images/reconstruction-rooms.png)" in page.read_text()
    assert (page.parent / "images" / "reconstruction-levels.svg").exists()


def test_a_suite_without_a_map_or_with_a_damaged_one_is_told(suite: Path) -> None:
    found = load_mapped(suite, read_plan(suite))
    (found[0].folder / FIGURES_FILE).write_text("{}")
    with pytest.raises(CovreconError, match=r"figures\.json: damaged"):
        write_study(suite)
    (suite / MAPS_FOLDER).rename(suite / "elsewhere")
    with pytest.raises(CovreconError, match="no map is made yet"):
        write_study(suite)
