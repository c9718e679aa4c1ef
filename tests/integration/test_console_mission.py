"""One whole mission commanded from a browser and from the command line: real processes, real images, real buttons."""

from __future__ import annotations

import asyncio
import json
import os
import sys
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest
from playwright.async_api import Page, async_playwright, expect

from faults.browser import BROWSER, OPTIONS, needs_browser
from faults.processes import processes_of, small_mission
from protocol.mission_file import mission_to_json
from protocol.operation_settings import Console

COVRECON = Path(sys.executable).with_name("covrecon")
PATIENCE_S = 90.0
"""For processes to start on a busy machine; what is pressed works within a second."""
POLL_S = 0.1

pytestmark = [
    pytest.mark.processes,
    pytest.mark.timeout(300),
    needs_browser,
]


async def until(condition: Callable[[], object], what: str) -> None:
    deadline = asyncio.get_running_loop().time() + PATIENCE_S
    while not condition():
        assert asyncio.get_running_loop().time() < deadline, what
        await asyncio.sleep(POLL_S)


@pytest.fixture
async def run(tmp_path: Path) -> AsyncIterator[asyncio.subprocess.Process]:
    """A mission that waits for its start, with a console; none of its processes may be left."""
    mission = small_mission(tmp_path, 2, stop_below=0.001, duration_s=300.0)
    path = tmp_path / "waiting.json"
    path.write_text(mission_to_json(mission.model_copy(update={"console": Console(port=0)})))
    run = await asyncio.create_subprocess_exec(
        COVRECON, "run", path, "--headless", "--console", "--wait", "--speed", "1", "--out", tmp_path / "runs",
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT,
    )  # fmt: skip
    yield run
    if run.returncode is None:
        run.terminate()
    await run.communicate()
    await until(lambda: not processes_of(tmp_path), "processes left behind")


@pytest.fixture
async def page(run: asyncio.subprocess.Process, tmp_path: Path) -> AsyncIterator[Page]:
    address = tmp_path / "runs" / "latest" / "console.json"
    await until(lambda: address.exists() or run.returncode is not None, "no console")
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=BROWSER, args=OPTIONS)
        page = await browser.new_page(viewport={"width": 900, "height": 1000})
        page.set_default_timeout(PATIENCE_S * 1000)
        expect.set_options(timeout=PATIENCE_S * 1000)
        await page.goto(json.loads(address.read_bytes())["url"])
        yield page
        await browser.close()


async def test_a_mission_is_started_paused_resumed_landed_and_aborted(
    run: asyncio.subprocess.Process, page: Page, tmp_path: Path
) -> None:
    folder = tmp_path / "runs" / "latest"
    fleet, metrics = page.locator("[data-console=fleet]"), folder / "metrics.csv"

    async def press(button: str, *, confirmed_by: str = "") -> None:
        await page.get_by_role("button", name=button, exact=True).click()
        if confirmed_by:
            await page.get_by_role("button", name=confirmed_by, exact=True).click()

    await expect(page.locator("[data-console=activity]")).to_have_text("waiting for an operator's start")
    await asyncio.sleep(1.0)
    assert len(metrics.read_text().splitlines()) <= 1, "nobody flies before the start"
    await press("Start mission")
    await until(lambda: len(metrics.read_text().splitlines()) > 3, "it never started")

    paused = await asyncio.create_subprocess_exec(
        COVRECON, "command", "pause", "--run", folder, stdout=asyncio.subprocess.PIPE
    )
    said, _ = await paused.communicate()
    assert paused.returncode == 0
    assert b"pause: drone 1, drone 3: acknowledged" in said
    await expect(fleet).to_contain_text("holding")
    await press("Resume all")
    await expect(page.locator("[data-console=command]")).to_have_text("resume all: acknowledged")
    await expect(fleet).not_to_contain_text("holding")

    await press("Land this drone", confirmed_by="Yes, land drone 1")
    await expect(fleet).to_contain_text("landed")
    await page.screenshot(path=Path(os.environ.get("COVRECON_ARTEFACTS", tmp_path)) / "console-mission.png")
    await press("Abort mission", confirmed_by="Yes, abort all drones")

    output, _ = await asyncio.wait_for(run.communicate(), PATIENCE_S)
    assert run.returncode == 0, output
    assert b"aborted by an operator" in output
    assert json.loads((folder / "summary.json").read_bytes())["exit_reason"] == "aborted by an operator"
