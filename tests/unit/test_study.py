"""Flights that never were, in a study's folder: what tables, figures and page say of them can be worked out by hand."""

from __future__ import annotations

import csv
import io
import itertools
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from faults.told import told
from ground_station.evaluation import Score, Scores
from ground_station.results import Metrics, RunFolder
from ground_station.study import paper
from ground_station.study.document import put_into, write_study
from ground_station.study.drawings import curves_over_seeds, rate_of
from ground_station.study.flown import Flown, by_series, load_flown, path_length, time_to
from ground_station.study.plan_file import FLIGHTS_FOLDER, Method, Plan, PlannedFlight, Study, write_plan
from ground_station.study.statistics import Difference, Spread, paired_difference, spread_of
from ground_station.study.tables import gain_rows, gain_text, gains_csv, method_rows, methods_csv, orders, spread_text
from protocol.errors import CovreconError
from protocol.map_settings import Feedback
from protocol.mission import Drone, Mission

DURATION_S = 30.0
CORNERS = np.array(list(itertools.product((-3.0, 3.0), (-3.0, 3.0), (0.0,))), np.float32)
FLOOR = np.array([[0, 2, 3], [0, 3, 1]], np.int32)
GREEN = np.full((4, 3), (0, 150, 40), np.uint8)
GAIN = {"none": 0.0, "grid": 0.06, "lawnmower": -0.1}
Make = Callable[..., Path]


def scores(f: float) -> Scores:
    """Precision and recall are equal, so all three are F; objects have 0.1 less."""
    return Scores(Score.of(f, f), Score.of(f, f), Score.of(f - 0.1, f - 0.1))


def planned(
    method: Method, drones: int = 1, threshold: float = 0.5, seed: int = 1, scene: str = "room"
) -> PlannedFlight:
    return PlannedFlight(method=method, drones=drones, threshold=threshold, scene=scene, seed=seed, key="0" * 64)


def fly(folder: Path, flight: PlannedFlight, *, mapped: bool = True) -> None:
    """J falls evenly to 0.4, by a team faster; each drone flies 1 m/s; F rises by 0.01 with each seed."""
    mission = Mission(
        name="study",
        feedback=Feedback(method="none" if flight.method in ("none", "lawnmower") else "grid"),
        drones=tuple(Drone(id=i, start=(2.0 * i - 5.0, 0.0, 2.0, 0.0, 1.3)) for i in range(1, flight.drones + 1)),
    )
    run = RunFolder(folder / FLIGHTS_FOLDER / flight.folder, mission)
    f = 0.6 + GAIN[flight.method] + 0.01 * flight.seed + (0.02 if flight.scene != "room" else 0.0)
    for tick in range(round(DURATION_S * 20) + 1):
        poses = {d.id: (d.start[0], tick / 20, 2.0, 0.0, 1.3) for d in mission.drones}
        run.record_tick(tick, tick / 20, poses, {drone: told() for drone in poses})
        if tick % 20 == 0:
            share = tick / 20 / DURATION_S
            importance = max(0.0, 1 - 0.6 * flight.drones * share)
            run.record_metrics(Metrics(tick / 20, tick, importance, scores(f * share) if share > 0 else None, 0, tick))
    if mapped:
        run.write_mesh(CORNERS, FLOOR, GREEN)
    final = Metrics(DURATION_S, 600, 0.4, scores(f), 0, 600)
    run.finish(
        final, floor_baseline=None, phi_sha256="0", wall_time_s=1.0, exit_reason="duration",
        feedback_update_s=None if mission.feedback.method == "none" else 0.01 * flight.seed,
    )  # fmt: skip
    run.close()


@pytest.fixture
def study(tmp_path: Path) -> Make:
    def make(kind: Study, flights: list[PlannedFlight], *, left: int = 0) -> Path:
        for flight in flights[: len(flights) - left]:
            fly(tmp_path, flight)
        plan = Plan(
            study=kind, command="covrecon bench", machine="2 cores", duration_s=DURATION_S, flights=tuple(flights)
        )
        write_plan(tmp_path, plan)
        return tmp_path

    return make


def flown_of(folder: Path) -> list[Flown]:
    from ground_station.study.plan_file import read_plan

    return load_flown(folder, read_plan(folder))


def rows_of(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


# --- statistics -------------------------------------------------------------------------------------------------------


def test_a_spread_leaves_out_what_there_is_not_and_says_so() -> None:
    spread = spread_of([1.0, math.nan, 3.0])
    assert (spread.mean, spread.deviation) == pytest.approx((2.0, math.sqrt(2)))
    assert (spread.known, spread.count) == (2, 3)
    assert spread_text(spread, 1) == "2.0 ± 1.4 (2 of 3)"
    assert spread_text(spread_of([5.0]), 0) == "5"
    assert spread_text(spread_of([math.nan]), 0) == "–"


def test_a_paired_difference_has_the_interval_of_student_s_t() -> None:
    first, second = [0.50, 0.60, 0.70, 0.80, 0.90], [0.52, 0.63, 0.71, 0.84, 0.95]
    gain = paired_difference(first, second)
    # Differences 2, 3, 1, 4, 5 hundredths: mean 3, deviation 1.5811; t(0.975, 4) = 2.7764 by the tables.
    assert gain.mean == pytest.approx(0.03)
    assert gain.half_width == pytest.approx(2.7764 * 0.015811 / math.sqrt(5), rel=1e-4)
    assert gain.count == 5


def test_pairs_that_lack_a_value_are_left_out_and_one_pair_has_no_interval() -> None:
    gain = paired_difference([0.5, math.nan, 0.6], [0.6, 0.9, math.nan])
    assert (gain.mean, gain.count) == (pytest.approx(0.1), 1)
    assert math.isnan(gain.half_width)


def test_an_interval_that_leaves_out_zero_is_in_bold() -> None:
    assert gain_text(Difference(0.02, 0.01, 5)) == "**+0.0200 [+0.0100, +0.0300]**"
    assert gain_text(Difference(-0.02, 0.03, 5)) == "-0.0200 [-0.0500, +0.0100]"
    assert gain_text(Difference(math.nan, math.nan, 0)) == "–"


# --- figures of one flight --------------------------------------------------------------------------------------------


def test_the_time_to_an_importance_is_the_first_row_at_or_below_it() -> None:
    time_s, importance = np.arange(5.0), np.array([1.0, 0.8, 0.5, 0.7, 0.3])
    assert time_to(time_s, importance, 0.5) == 2.0
    assert math.isnan(time_to(time_s, importance, 0.25))


def test_the_path_is_that_of_all_drones_and_passes_over_what_was_not_heard() -> None:
    poses = np.zeros((4, 2, 5))
    poses[:, 0, 0] = [0, 1, 2, 3]
    poses[:, 1, 1] = [0, 2, np.nan, 6]
    poses[:, :, 3] = 7.0  # turning is no way
    assert path_length(poses) == pytest.approx(3 + 6)


def test_the_rate_of_a_line_is_its_slope() -> None:
    time_s = np.arange(40.0)
    rate = rate_of(time_s, 1 - 0.02 * time_s)
    assert np.nanmax(np.abs(rate + 0.02)) < 1e-12
    assert np.isnan(rate[[0, -1]]).all()
    assert np.isnan(rate_of(time_s[:3], time_s[:3])).all()


# --- tables -----------------------------------------------------------------------------------------------------------

PAPER_FLIGHTS = [
    planned(method, drones, threshold, seed)
    for seed in (1, 3)
    for method, drones, threshold in (
        ("lawnmower", 1, 0.5),
        ("none", 1, 0.5),
        ("grid", 1, 0.5),
        ("grid", 4, 0.5),
        ("grid", 1, 0.3),
    )
]


def test_a_method_s_row_has_mean_and_spread_over_the_seeds_and_the_paper_s_figures(study: Make) -> None:
    rows = method_rows(flown_of(study("paper", PAPER_FLIGHTS)))
    assert [row.series[1:] for row in rows] == [flight.series[1:] for flight in PAPER_FLIGHTS[:5]]
    _, none, grid, team, eager = rows
    assert grid.spreads["f_visible"].mean == pytest.approx(0.68)
    assert grid.spreads["f_visible"].deviation == pytest.approx(math.sqrt(2) / 100)
    assert grid.spreads["f_objects"].mean == pytest.approx(0.58)
    assert grid.spreads["path_m"].mean == pytest.approx(30.0)
    assert team.spreads["path_m"].mean == pytest.approx(120.0)
    assert team.spreads["separation_m"].mean == pytest.approx(2.0)
    assert grid.spreads["update_s"].mean == pytest.approx(0.02)
    assert none.spreads["update_s"] == Spread(
        pytest.approx(math.nan, nan_ok=True), pytest.approx(math.nan, nan_ok=True), 0, 2
    )
    assert [team.spreads[f"time_to_{level}_s"].mean for level in ("0.75", "0.5", "0.25")] == [4.0, 7.0, 10.0]
    assert grid.spreads["time_to_0.25_s"].known == 0
    assert grid.paper == {"f_visible": 0.438, "time_to_0.25_s": 850.0, "update_s": 0.2131}
    assert team.paper == {"f_visible": 0.423, "time_to_0.25_s": 320.0}
    assert eager.paper == {}


def test_the_table_as_csv_is_of_numbers_alone(study: Make) -> None:
    rows = rows_of(methods_csv(method_rows(flown_of(study("paper", PAPER_FLIGHTS)))))
    grid = rows[2]
    assert (grid["method"], grid["drones"], grid["flights"]) == ("grid", "1", "2")
    assert float(grid["f_visible"]) == pytest.approx(0.68)
    assert float(grid["f_visible_paper"]) == 0.438
    assert (grid["time_to_0.25_s"], grid["time_to_0.25_s_known"]) == ("", "0")


def test_methods_are_ordered_by_their_f_beside_the_paper_s_order(study: Make) -> None:
    ranked = dict(orders(method_rows(flown_of(study("paper", PAPER_FLIGHTS)))))
    assert ranked == {
        "F visible": ["grid", "none", "lawnmower"],
        "F objects": ["grid", "none", "lawnmower"],
        "paper": ["grid", "none", "lawnmower"],
    }


def test_the_gain_is_of_pairs_of_one_scene_and_seed_at_equal_time(study: Make) -> None:
    flights = [
        planned(method, seed=seed, scene=scene)
        for scene in ("room", "hall")
        for seed in (1, 2, 4)
        for method in ("none", "grid")
    ]
    rows = gain_rows(flown_of(study("feedback", [*flights, planned("none", seed=9)])), DURATION_S)
    assert [(row.scene, row.moment) for row in rows] == [
        (scene, moment) for scene in ("room", "hall", "all scenes") for moment in ("early", "middle", "end")
    ]
    assert [row.gains["visible"].count for row in rows] == [3] * 6 + [6] * 3
    early, middle, end = rows[:3]
    assert [row.gains["visible"].mean for row in (early, middle, end)] == pytest.approx([0.02, 0.04, 0.06], abs=1e-6)
    assert end.gains["objects"].mean == pytest.approx(0.06, abs=1e-6)
    assert end.without["visible"].mean == pytest.approx(0.6 + 0.07 / 3)
    table = rows_of(gains_csv(rows))
    assert float(table[2]["f_visible_gain_low"]) <= 0.06 <= float(table[2]["f_visible_gain_high"])


# --- figures and pages ------------------------------------------------------------------------------------------------


def test_a_band_runs_from_the_lowest_to_the_highest_seed(study: Make) -> None:
    flights = by_series(flown_of(study("paper", [planned("grid", seed=seed) for seed in (1, 3)])))
    (grid,) = flights.values()
    time_s, mean, low, high = curves_over_seeds(grid, "f_score_visible")
    assert time_s[-1] == DURATION_S
    assert np.isnan(mean[0])  # not scored yet
    assert (low[-1], mean[-1], high[-1]) == pytest.approx((0.67, 0.68, 0.69))


def test_tables_figures_and_page_are_made_of_the_folder_alone_and_are_the_same_each_time(study: Make) -> None:
    folder = study("paper", PAPER_FLIGHTS)
    page = write_study(folder)
    made = {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    assert {"evaluation.md", "methods.csv", "J.svg", "J.png", "F.svg", "F.png", "portraits.svg", "meshes.png"} <= set(
        made
    )
    text = page.read_text()
    assert "10 of 10 flights of 30 s, on 2 cores" in text
    for method, drones, threshold in {flight.series[1:] for flight in PAPER_FLIGHTS}:
        assert f"| {paper.label(method, drones, threshold)} | 2 |" in text
    assert "Four drones' F of the visible surface is one drone's +0.000." in text
    with Image.open(folder / "meshes.png") as picture:
        pixels = np.asarray(picture.convert("RGB")).reshape(-1, 3).astype(int)
    assert ((pixels[:, 1] > pixels[:, 0] + 40) & (pixels[:, 1] > pixels[:, 2] + 40)).mean() > 0.05  # green floors
    write_study(folder)
    assert {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()} == made


def test_a_study_that_is_not_flown_to_its_end_is_told_as_far_as_it_is(study: Make) -> None:
    folder = study("paper", PAPER_FLIGHTS, left=5)
    text = write_study(folder).read_text()
    assert "5 of 10 flights" in text
    assert "±" not in text.splitlines()[6]


def test_a_study_without_a_flight_has_no_page(study: Make) -> None:
    with pytest.raises(CovreconError, match="no flight is flown to its end yet"):
        write_study(study("paper", PAPER_FLIGHTS, left=len(PAPER_FLIGHTS)))


def test_flights_without_a_map_have_all_but_their_picture(study: Make, tmp_path: Path) -> None:
    flight = planned("none")
    folder = study("paper", [flight], left=1)
    fly(tmp_path, flight, mapped=False)
    write_study(folder)
    assert (folder / "J.svg").exists()
    assert not (folder / "meshes.png").exists()


def test_results_come_between_the_comments_of_a_page_and_figures_beside_it(study: Make, tmp_path: Path) -> None:
    flights = [planned(method, seed=seed) for seed in (1, 2) for method in ("none", "grid")]
    folder = study("feedback", flights)
    write_study(folder)
    page = tmp_path / "docs" / "evaluation.md"
    page.parent.mkdir()
    page.write_text("before\n<!-- feedback -->\nof yesterday\n<!-- /feedback -->\nafter\n")
    for _ in range(2):
        put_into(page, folder)
        text = page.read_text()
        assert text.startswith("before\n<!-- feedback -->\n### Does feedback help?")
        assert text.endswith("<!-- /feedback -->\nafter\n")
        assert "of yesterday" not in text
        assert "](images/feedback-gain.svg)" in text
        assert (page.parent / "images" / "feedback-gain.svg").read_bytes() == (folder / "gain.svg").read_bytes()
    page.write_text("nothing\n")
    with pytest.raises(CovreconError, match="lacks the lines <!-- feedback -->"):
        put_into(page, folder)
