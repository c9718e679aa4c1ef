"""The report and its replay in a real browser, opened from disk: they play, and ask for nothing but themselves."""

from __future__ import annotations

import itertools
import math
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from faults.browser import BROWSER, OPTIONS, needs_browser
from faults.told import told
from ground_station.report import write_report
from ground_station.results import Metrics, RunFolder
from protocol.field import VirtualField
from protocol.mission import Drone, Mission

playwright = pytest.importorskip("playwright.sync_api", reason="the browser tests need playwright")

pytestmark = [
    pytest.mark.processes,
    needs_browser,
]

MISSION = Mission.model_validate(
    {
        "name": "orchard",
        "duration_s": 20.0,
        "drones": [Drone(id=i, start=(1.5 * i - 3, 0.0, 2.0, 0.0, 1.4)) for i in (1, 2, 3)],
    }
)
TICKS = 300
PAGE_BYTES_MAX = 5_000_000
GREEN = (0, 150, 40)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of three drones on circles over a green floor, with its report."""
    path = tmp_path_factory.mktemp("run")
    run = RunFolder(path, MISSION)
    for tick in range(TICKS):
        angles = {drone.id: 0.02 * tick + 2 * math.pi * drone.id / 3 for drone in MISSION.drones}
        poses = {drone: (2 * math.cos(a), 2 * math.sin(a), 2.0, 0.1, 1.3) for drone, a in angles.items()}
        run.record_tick(tick, tick / 20, poses, {drone: told(solve_s=0.0005 * (1 + tick % 7)) for drone in poses})
        if tick % 20 == 0:
            run.record_metrics(Metrics(tick / 20, tick, math.exp(-tick / 200), None, 0, tick // 4))
    corners = np.array(list(itertools.product((-3.0, 3.0), (-3.0, 3.0), (0.0,))), np.float32)
    run.write_mesh(corners, np.array([[0, 2, 3], [0, 3, 1]], np.int32), np.full((4, 3), GREEN, np.uint8))
    field = VirtualField.of(MISSION.target)
    run.write_phi(np.full(field.shape, 0.5, np.float32), field)
    final = Metrics(15.0, TICKS, 0.2, None, 0, 75)
    run.finish(final, floor_baseline=None, phi_sha256="0", wall_time_s=5.0, exit_reason="stopped")
    run.close()
    write_report(path)
    return path


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as running:
        chromium = running.chromium.launch(executable_path=BROWSER, args=[*OPTIONS, "--use-angle=swiftshader"])
        yield chromium
        chromium.close()


class Watched:
    """A page, what it asked for, and what it complained of."""

    def __init__(self, browser: Any, path: Path) -> None:
        self.page = browser.new_page(viewport={"width": 1240, "height": 900})
        self.asked: list[str] = []
        self.complaints: list[str] = []
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("console", lambda said: self.complaints.append(said.text) if said.type == "error" else None)
        self.page.goto(path.as_uri())

    def keep(self, name: str, tmp_path: Path) -> None:
        kept = Path(os.environ.get("COVRECON_ARTEFACTS", tmp_path)) / name
        kept.parent.mkdir(parents=True, exist_ok=True)
        self.page.screenshot(path=kept)


def test_the_report_opens_the_replay_only_when_asked_and_nothing_else(
    folder: Path, browser: Any, tmp_path: Path
) -> None:
    watched = Watched(browser, folder / "report.html")
    page = watched.page
    assert page.title() == "orchard · Coverage-Recon report"
    assert page.locator("section.card svg").count() == 8
    assert watched.asked == [(folder / "report.html").as_uri()]

    page.get_by_text("Flight in 3-D").click()
    replay = page.frame_locator("iframe")
    replay.locator("canvas").first.wait_for()
    assert watched.asked == [(folder / name).as_uri() for name in ("report.html", "replay.html")]
    assert watched.complaints == []
    watched.keep("report.png", tmp_path)
    page.close()


def test_the_replay_plays_by_itself_and_asks_for_nothing(folder: Path, browser: Any, tmp_path: Path) -> None:
    assert (folder / "replay.html").stat().st_size < PAGE_BYTES_MAX
    watched = Watched(browser, folder / "replay.html")
    page = watched.page
    assert page.title() == "orchard · Coverage-Recon replay"
    page.locator("canvas").first.wait_for()
    clock = page.locator("input").first
    page.wait_for_function("document.querySelector('input')?.value > 3", timeout=60_000)
    assert re.fullmatch(r"\d+\.\d", clock.input_value())
    watched.keep("replay.png", tmp_path)
    assert watched.asked == [(folder / "replay.html").as_uri()]
    assert watched.complaints == []
    page.close()
