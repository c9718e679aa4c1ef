"""Which flights a study is made of, what tells two of them apart, and which are left after an interrupt."""

from __future__ import annotations

import math
import re
from collections import Counter
from pathlib import Path
from typing import get_args

import pytest

from deploy.bench.campaign import left_of
from deploy.bench.flight import keep
from deploy.bench.plan import (
    ALL_METHODS,
    METHODS,
    Job,
    Wish,
    assignments,
    feedback_jobs,
    key_of,
    paper_jobs,
    plan_of,
    started_by_seed,
)
from deploy.bench_command import Which
from ground_station.study.plan_file import FLIGHTS_FOLDER, Method, read_plan, write_plan
from protocol.errors import MissionError, StorageError
from protocol.guard import ROOT
from protocol.mission_file import load_mission

PAPER = ROOT / "missions" / "paper.toml"
FLOWN: tuple[Method, ...] = ("none", "grid")


def wish(seeds: int = 2, duration_s: float = 300.0, **settings: object) -> Wish:
    return Wish(PAPER, duration_s, seeds, {name.replace("__", "."): value for name, value in settings.items()})


def kinds(jobs: list[Job]) -> Counter[tuple[str, int, float]]:
    return Counter((job.planned.method, job.planned.drones, job.planned.threshold) for job in jobs)


def test_every_method_can_be_wished_for_and_is_flown_by_some_planner() -> None:
    assert set(get_args(Method)) == set(METHODS) == set(get_args(Which))


def test_each_method_flies_alone_and_grid_feedback_also_in_teams_and_with_other_thresholds() -> None:
    assert kinds(paper_jobs(wish(seeds=3), FLOWN)) == {
        ("none", 1, 0.5): 3,
        ("grid", 1, 0.5): 3,
        ("grid", 2, 0.5): 3,
        ("grid", 4, 0.5): 3,
        ("grid", 1, 0.3): 3,
        ("grid", 1, 0.7): 3,
    }


def test_the_whole_table_has_every_method_and_all_of_its_missions_hold() -> None:
    jobs = paper_jobs(wish(seeds=1), ALL_METHODS)
    single = [job for job in jobs if (job.planned.drones, job.planned.threshold) == (1, 0.5)]
    assert [job.planned.method for job in single] == list(get_args(Method))
    assert [(job.mission.controller.planner, job.mission.feedback.method) for job in single] == list(METHODS.values())
    assert len(jobs) == len({job.planned.folder for job in jobs}) == len(METHODS) + 4


def test_a_flight_that_is_wished_for_twice_is_planned_once() -> None:
    jobs = paper_jobs(wish(seeds=1, feedback__threshold=0.3), ("grid", "grid"))
    assert len(jobs) == len({job.planned.name for job in jobs}) == 4


def test_flights_of_a_study_do_what_their_method_says() -> None:
    none, grid = paper_jobs(wish(seeds=1), FLOWN)[:2]
    assert (none.mission.controller.planner, none.mission.feedback.method) == ("coverage", "none")
    assert (grid.mission.controller.planner, grid.mission.feedback.method) == ("coverage", "grid")
    assert {job.mission.duration_s for job in (none, grid)} == {300.0}
    assert grid.mission.simulation.scene == "living_room"


def test_settings_change_all_flights_but_not_what_is_compared() -> None:
    settings = {"feedback__kappa": 0.5, "feedback__method": "none"}
    jobs = feedback_jobs(wish(seeds=1, **settings), ["living_room"])
    assert [(job.mission.feedback.method, job.mission.feedback.kappa) for job in jobs] == [("none", 0.5), ("grid", 0.5)]


def test_feedback_is_compared_in_each_scene_with_each_seed(tmp_path: Path) -> None:
    other = tmp_path / "hall.obj"
    other.touch()
    jobs = feedback_jobs(wish(seeds=5), ["living_room", str(other)])
    assert Counter((job.planned.scene, job.planned.method) for job in jobs) == {
        ("living_room", "none"): 5,
        ("living_room", "grid"): 5,
        ("hall", "none"): 5,
        ("hall", "grid"): 5,
    }


def test_flights_of_one_seed_begin_alike_whatever_the_method_and_the_team() -> None:
    jobs = paper_jobs(wish(seeds=2), FLOWN)
    for seed in (1, 2):
        assert len({job.mission.drones[0].start for job in jobs if job.planned.seed == seed}) == 1


def test_seeds_differ_in_where_drones_start_which_way_they_look_and_in_the_noise_of_their_cameras() -> None:
    missions = [started_by_seed(load_mission(PAPER, seed=seed)) for seed in range(1, 9)]
    starts = [mission.drones[0].start for mission in missions]
    assert len(set(starts)) == len({mission.seed for mission in missions}) == 8
    assert all(math.dist(start[:2], (0.0, 1.0)) <= 0.2 * math.sqrt(2) for start in starts)
    assert {start[2:3] + start[4:] for start in starts} == {(2.0, 1.3)}
    assert max(start[3] for start in starts) - min(start[3] for start in starts) > math.pi


@pytest.mark.parametrize("drones", [4, 9])
def test_teams_keep_their_separation_at_every_start(drones: int) -> None:
    for seed in range(50):
        started_by_seed(load_mission(PAPER, drones=drones, seed=seed))  # checks it


def test_a_start_at_the_region_s_edge_stays_inside(tmp_path: Path) -> None:
    edge = tmp_path / "edge.toml"
    edge.write_text("[[drones]]\nid = 1\nstart = [4.0, -4.0, 2.0, 0.0, 1.3]\n")
    for seed in range(20):
        x, y, *_ = started_by_seed(load_mission(edge, seed=seed)).drones[0].start
        assert 3.8 <= x <= 4.0
        assert -4.0 <= y <= -3.8


def test_drones_that_are_placed_as_near_as_they_may_be_are_refused_for_a_seed_that_moves_them_together(
    tmp_path: Path,
) -> None:
    near = tmp_path / "near.toml"
    text = "".join(f"[[drones]]\nid = {i}\nstart = [{i}.0, 0.0, 2.0, 0.0, 1.3]\n" for i in (1, 2))
    near.write_text(text)
    refused = []
    for seed in range(20):
        try:
            started_by_seed(load_mission(near, seed=seed))
        except MissionError as error:
            refused.append(str(error))
    assert 0 < len(refused) < 20
    assert all(re.match(r"seed \d+: drones.1.start: [01].\d+ m from drone 1", fault) for fault in refused), refused


def test_a_key_tells_settings_and_versions_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    mission = load_mission(PAPER)
    key = key_of(mission)
    assert key == key_of(load_mission(PAPER))
    assert key != key_of(load_mission(PAPER, seed=2))
    assert key != key_of(load_mission(PAPER, replaced={"feedback.kappa": 0.6}))
    monkeypatch.setattr("deploy.bench.plan.versions", lambda: {"numba": "0"})
    assert key != key_of(mission)


def test_what_is_flown_is_not_left_and_what_was_cut_short_is(tmp_path: Path) -> None:
    jobs = paper_jobs(wish(seeds=2), FLOWN)
    assert len(left_of(tmp_path, jobs)) == len(jobs)
    flights = tmp_path / FLIGHTS_FOLDER
    keep({"summary.json": b"{}"}, flights / jobs[0].planned.folder)
    (flights / f".{jobs[1].planned.folder}.draft").mkdir()
    left = left_of(tmp_path, jobs)
    assert {job.planned.name for job in left} == {job.planned.name for job in jobs[1:]}
    changed = paper_jobs(wish(seeds=2, feedback__kappa=0.6), FLOWN)
    assert len(left_of(tmp_path, changed)) == len(changed)


def test_first_seeds_are_flown_first_and_of_a_seed_the_large_teams(tmp_path: Path) -> None:
    order = [(job.planned.seed, job.planned.drones) for job in left_of(tmp_path, paper_jobs(wish(seeds=2), FLOWN))]
    assert order == [(seed, drones) for seed in (1, 2) for drones in (4, 2, 1, 1, 1, 1)]


def test_a_flight_s_folder_appears_only_when_it_is_whole(tmp_path: Path) -> None:
    with pytest.raises(TypeError):
        keep({"summary.json": b"{}", "mesh.ply": None}, tmp_path / "flight")  # type: ignore[dict-item]
    assert not (tmp_path / "flight").exists()


def test_a_plan_is_read_as_it_was_written(tmp_path: Path) -> None:
    plan = plan_of("paper", wish(), paper_jobs(wish(), FLOWN), "covrecon bench paper")
    write_plan(tmp_path / "new" / "study", plan)
    assert read_plan(tmp_path / "new" / "study") == plan
    with pytest.raises(StorageError, match="is this the folder of a study"):
        read_plan(tmp_path)


def test_settings_are_toml_or_words() -> None:
    found = assignments(["feedback.kappa=0.5", "simulation.scene = room-3", "reconstruction.workers=1"])
    assert found == {"feedback.kappa": 0.5, "simulation.scene": "room-3", "reconstruction.workers": 1}
    with pytest.raises(MissionError, match="must be like"):
        assignments(["feedback.kappa"])
