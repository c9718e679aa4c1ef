"""The report: whatever a run left behind, one page that needs nothing else and is the same each time."""

from __future__ import annotations

import html.parser
import io
import itertools
import math
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from faults.told import told
from faults.zones import l_shaped
from ground_station.evaluation import Score, Scores
from ground_station.report import flight_figures, page, write_report
from ground_station.report.picture import oblique_view, view_from_above
from ground_station.report.run_data import Mesh
from ground_station.report.run_folder import load_run
from ground_station.results import Metrics, RunFolder
from protocol.errors import CovreconError, MissionError
from protocol.map_settings import Feedback, Reconstruction
from protocol.messages import UNLIMITED
from protocol.mission import Drone, Mission

SCORES = Scores(visible=Score.of(0.96, 0.8), exposed=Score.of(0.96, 0.7), objects=Score.of(0.9, 0.6))
FLOOR = Scores(visible=Score.of(1.0, 0.5), exposed=Score.of(1.0, 0.4), objects=Score.of(0.0, 0.0))
TICKS = 400
SMALL_PX = (160, 90)
RED, BLUE = (200, 40, 40), (40, 60, 200)


@pytest.fixture(autouse=True)
def _small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page, "OBLIQUE_PX", SMALL_PX)
    monkeypatch.setattr(page, "PLAN_PX", 90)
    monkeypatch.setattr(page, "replay_page", lambda *_: "<!doctype html>")  # test_replay_page.py


def team(drones: int, **settings: object) -> Mission:
    starts = tuple(Drone(id=i + 1, start=(1.5 * i - 3, 0.0, 2.0, 0.0, 1.4)) for i in range(drones))
    return Mission.model_validate({"name": "living-room", "duration_s": 20.0, "drones": starts, **settings})


def a_table_on_a_floor() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A blue floor over the target and a red square 1 m above it, over x, y in [1, 2]."""
    floor = [[-3, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0]]
    top = [[1, 1, 1], [2, 1, 1], [2, 2, 1], [1, 2, 1]]
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)
    return np.array(floor + top, np.float32), faces, np.array([BLUE] * 4 + [RED] * 4, np.uint8)


def flown(
    folder: Path,
    mission: Mission,
    *,
    mapped: bool = True,
    scores: Scores | None = SCORES,
    finished: bool = True,
    contacts: dict[int, int] | None = None,
) -> Path:
    """The folder of a run of ``TICKS`` ticks: drones on circles, J falling, jumps below the threshold."""
    run = RunFolder(folder, mission)
    rng = np.random.default_rng(1)
    ids = [drone.id for drone in mission.drones]
    jumps = 0
    final = Metrics(0.0, 0, 1.0, None, 0, 0)
    for tick in range(TICKS):
        angles = {drone: 0.02 * tick + 2 * math.pi * drone / len(ids) for drone in ids}
        poses = {drone: (2 * math.cos(a), 2 * math.sin(a), 2.0, 0.1, 1.3) for drone, a in angles.items()}
        states = {
            drone: told(
                solve_s=float(rng.lognormal(-7, 0.3)),
                slack=-0.25,
                outcome="infeasible" if drone == ids[-1] and tick in (50, 51) else "solved",
                battery=1 - tick / 1000,
                obstacle_m=0.3 + 0.4 * math.sin(tick / 40) if mission.flight.obstacles.enabled else UNLIMITED,
            )
            for drone in ids
        }
        run.record_tick(tick, tick / 20, poses, states)
        if tick % 20 == 0:
            importance = math.exp(-tick / 200)
            jumps += importance < mission.feedback.threshold and mission.feedback.method != "none"
            final = Metrics(tick / 20, tick, importance, scores if tick > 100 else None, jumps, tick // 4)
            run.record_metrics(final)
    if mapped:
        run.write_mesh(*a_table_on_a_floor())
    run.checkpoint()
    if finished:
        run.finish(
            final,
            floor_baseline=FLOOR if scores else None,
            phi_sha256="9f" * 32,
            wall_time_s=3.8,
            exit_reason="duration of 20 s reached",
            contacts=contacts,
        )
    run.close()
    return folder


class Page(html.parser.HTMLParser):
    """Words of a page, its tags, and every address it refers to; refuses tags that do not nest."""

    VOID = frozenset({"meta", "link", "img"})
    REFERENCES = frozenset({"src", "href", "xlink:href", "action", "data-page"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.words: list[str] = []
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self._open: list[str] = []
        self.feed(text)
        assert not self._open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        if tag not in self.VOID:
            self._open.append(tag)
        self.addresses += [value or "" for name, value in attrs if name in self.REFERENCES]

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in self.VOID:
            self._open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        if data.strip() and self._open[-1] != "style":
            self.words.append(" ".join(data.split()))


def page_of(folder: Path) -> Page:
    return Page(write_report(folder).read_text(encoding="utf-8"))


def kpis(shown: Page) -> dict[str, tuple[str, str]]:
    """Value and note by label; the row is the page's first list."""
    words = shown.words[: shown.words.index("Map")]
    start = words.index("Importance J")
    labels = ["Importance J", "F-score, visible", "F-score, exposed", "F-score, objects", "Nearest approach", "Jumps",
              "Keyframes", "Mission time", "Wall time", "Speed"]  # fmt: skip
    at = [words.index(label, start) for label in labels] + [len(words)]
    rows = [words[first:last] for first, last in itertools.pairwise(at)]
    return {row[0]: (row[1], row[2] if len(row) > 2 else "") for row in rows}


def test_a_complete_run_is_told_in_full(tmp_path: Path) -> None:
    shown = page_of(flown(tmp_path, team(3)))
    told = kpis(shown)
    assert told["F-score, visible"] == ("0.873", "bare floor 0.667")
    assert told["F-score, objects"] == ("0.720", "bare floor 0.000")
    assert told["Importance J"] == ("0.150", "below J_th = 0.5 after 7 s")
    assert told["Nearest approach"] == ("3.464 m", "limit 1 m")
    assert told["Jumps"] == ("13", "grid feedback")
    assert told["Keyframes"] == ("95", "plane sweep")
    assert told["Mission time"] == ("19.0 s", "at most 20 s")
    assert told["Wall time"][0] == "3.8 s"
    assert told["Speed"][0] == "5.0 ×"
    assert "ended: duration of 20 s reached" in shown.words
    assert "2 (infeasible 2)" in shown.words
    assert "0.25" in shown.words  # largest slack
    assert shown.tags.count("svg") == 9
    assert shown.words.count("60 %") == 3  # battery left
    assert shown.words[shown.words.index("Faults seen") :][5:9] == [
        "2.5 s", "0.1 s", "drone 3", "braked for 2 ticks: infeasible 2"
    ]  # fmt: skip
    assert {"[sensing]", "sigma_axis", "0.07", "9f" * 32} <= set(shown.words)


def test_contacts_with_the_scene_are_told_by_drone_where_somebody_counted(tmp_path: Path) -> None:
    touched = page_of(flown(tmp_path / "touched", team(3), contacts={1: 0, 2: 1203, 3: 4})).words
    at = touched.index("Contacts with the scene")
    assert touched[at + 1 : at + 3] == ["1,207", "of drones 2, 3"]
    assert touched.count("1,203") == 1
    clear = page_of(flown(tmp_path / "clear", team(2), contacts={1: 0, 2: 0})).words
    at = clear.index("Contacts with the scene")
    assert clear[at + 1 : at + 3] == ["0", "of no drone"]
    assert "Contacts with the scene" not in page_of(flown(tmp_path / "unjudged", team(2))).words


def test_paths_are_drawn_with_the_zones_that_were_flown_around(tmp_path: Path) -> None:
    mission = team(2, flight=l_shaped().model_dump())
    text = write_report(flown(tmp_path, mission)).read_text()
    assert "no-fly zone" in text
    assert ">boundary<" in text
    assert "no-fly zone" not in write_report(flown(tmp_path / "open", team(2))).read_text()


def test_the_page_asks_the_network_for_nothing(tmp_path: Path) -> None:
    shown = page_of(flown(tmp_path, team(2)))
    assert shown.addresses
    assert all(address.startswith(("data:", "#")) or address == "replay.html" for address in shown.addresses)
    assert (tmp_path / "replay.html").exists()
    assert "script" not in shown.tags
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert not re.findall(r"url\((?!#)|@import", text)


def test_the_same_folder_gives_the_same_bytes(tmp_path: Path) -> None:
    flown(tmp_path, team(2))
    first = write_report(tmp_path).read_bytes()
    picture = (tmp_path / "mesh.png").read_bytes()
    assert write_report(tmp_path).read_bytes() == first
    assert (tmp_path / "mesh.png").read_bytes() == picture


def test_a_run_that_was_cut_short_is_told_from_its_rows(tmp_path: Path) -> None:
    flown(tmp_path, team(2), mapped=False, finished=False)
    with (tmp_path / "metrics.csv").open("a") as file:
        file.write("20.0,400,0.1")  # torn by a full disk
    shown = page_of(tmp_path)
    told = kpis(shown)
    assert told["Importance J"][0] == "0.150"
    assert told["F-score, visible"] == ("0.873", "bare floor not recorded")
    assert told["Nearest approach"][0] == "4.000 m"
    assert told["Wall time"] == ("–", "not recorded")
    assert any(word.startswith("cut short") for word in shown.words)
    assert "The run left no map." in shown.words


def test_one_drone_without_feedback_map_and_truth_still_gets_a_page(tmp_path: Path) -> None:
    mission = team(1, feedback=Feedback(method="none"), reconstruction=Reconstruction(backend="none"))
    shown = page_of(flown(tmp_path, mission, mapped=False, scores=None))
    told = kpis(shown)
    assert told["F-score, visible"] == ("–", "no map or no truth")
    assert told["Nearest approach"] == ("–", "one drone")
    assert told["Jumps"] == ("0", "no feedback")
    assert told["Keyframes"][1] == "no reconstruction"
    assert "The mission reconstructs nothing (reconstruction.backend is none)." in shown.words
    assert "One drone: nobody to keep apart from." in shown.words
    assert shown.tags.count("svg") == 7
    assert not (tmp_path / "mesh.png").exists()


@pytest.mark.parametrize("enabled", [False, True])
def test_margins_of_obstacles_are_drawn_where_there_are_any(tmp_path: Path, *, enabled: bool) -> None:
    folder = flown(tmp_path, team(2, flight={"obstacles": {"enabled": enabled}}), mapped=False)
    flight = load_run(folder).flight
    assert flight is not None
    svg = flight_figures.margins(flight, team(2))
    assert svg.count("separation (m²)</text>") == 1
    assert svg.count("obstacles (m)</text>") == enabled


def test_a_run_that_never_took_off_gets_a_page(tmp_path: Path) -> None:
    RunFolder(tmp_path, team(2)).close()
    shown = page_of(tmp_path)
    assert "svg" not in shown.tags
    assert {"No metrics were recorded.", "No trajectories were recorded."} <= set(shown.words)
    assert "Nothing was recorded in which one could be seen." in shown.words
    assert not (tmp_path / "replay.html").exists()


def test_too_near_and_worse_than_a_floor_are_marked(tmp_path: Path) -> None:
    poor = Scores(visible=Score.of(0.5, 0.5), exposed=Score.of(0.9, 0.9), objects=Score.of(0.9, 0.9))
    mission = team(2, flight={"separation_m": 1.2})
    run = RunFolder(tmp_path, mission)
    run.record_tick(0, 0.0, {1: (0, 0, 1, 0, 1), 2: (1.1, 0, 1, 0, 1)}, {})
    final = Metrics(0.0, 0, 0.1, poor, 0, 0)
    run.record_metrics(final)
    run.finish(final, floor_baseline=FLOOR, phi_sha256="0", wall_time_s=1.0, exit_reason="stopped")
    run.close()
    text = write_report(tmp_path).read_text(encoding="utf-8")
    marked = re.findall(r'class="kpi (\w*)"><dt>([^<]*)', text)
    assert [label for state, label in marked if state == "bad"] == ["F-score, visible", "Nearest approach"]
    assert [label for state, label in marked if state == "good"] == ["F-score, exposed", "F-score, objects"]


def test_words_of_the_run_cannot_break_out_of_the_page(tmp_path: Path) -> None:
    mission = team(1, simulation={"scene": "<script>alert(1)</script>"})
    shown = page_of(flown(tmp_path, mission, mapped=False))
    assert "script" not in shown.tags
    assert any("<script>alert(1)</script>" in word for word in shown.words)


def test_the_plan_shows_colours_where_they_are() -> None:
    mesh = Mesh(*a_table_on_a_floor())
    plan = view_from_above(mesh, (-3, -3, 0), (3, 3, 2), 120)
    assert plan.shape == (120, 120, 3)
    red = (plan[..., 0].astype(int) - plan[..., 2]) > 50
    rows, columns = np.nonzero(red)
    # x in [1, 2] lies right of the middle, y in [1, 2] above it; 20 pixels a metre.
    assert (columns.min(), columns.max()) == pytest.approx((80, 99), abs=1)
    assert (rows.min(), rows.max()) == pytest.approx((20, 39), abs=1)


def test_a_long_target_gives_a_long_plan_of_bounded_size() -> None:
    mesh = Mesh(*a_table_on_a_floor())
    assert view_from_above(mesh, (-1, -50, 0), (1, 50, 2), 200).shape == (200, 4, 3)


@pytest.mark.parametrize("offset_m", [0.0, 5000.0])
def test_the_oblique_view_frames_the_whole_mesh_wherever_it_lies(offset_m: float) -> None:
    vertices, faces, colours = a_table_on_a_floor()
    view = oblique_view(Mesh(vertices + np.float32(offset_m), faces, colours), 160, 90)
    drawn = np.argwhere((view < 250).any(axis=2))
    assert (drawn.min(axis=0) > 0).all()
    assert (drawn.max(axis=0) < (89, 159)).all()
    assert max(np.ptp(drawn, axis=0) / (90, 160)) > 0.85


def test_the_picture_beside_the_page_is_the_one_inside(tmp_path: Path) -> None:
    flown(tmp_path, team(1))
    shown = page_of(tmp_path)
    with Image.open(io.BytesIO((tmp_path / "mesh.png").read_bytes())) as image:
        assert image.size == SMALL_PX
    assert shown.tags.count("img") == 2


def test_a_folder_without_a_mission_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(MissionError, match=r"mission\.json: No such file or directory; is this the folder of a run"):
        write_report(tmp_path)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("summary.json", b"{"),
        ("trajectories.npz", b"PK\x03\x04"),
        ("metrics.csv", b"time_s,tick\n1.0,x\n"),
        ("mesh.ply", b"ply\nnonsense"),
        ("mission.json", b'{"name": "x"}'),
    ],
)
def test_a_damaged_file_is_refused_by_name(tmp_path: Path, name: str, content: bytes) -> None:
    flown(tmp_path, team(1), mapped=False)
    (tmp_path / name).write_bytes(content)
    with pytest.raises(CovreconError, match=re.escape(name)):
        load_run(tmp_path)
