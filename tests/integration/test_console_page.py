"""The console's own process in a real browser: what it shows is what was said, and what is pressed is commanded."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import pytest
import pytest_asyncio
from playwright.async_api import ConsoleMessage, Locator, Page, Request, ViewportSize, async_playwright, expect

from deploy.local import environment
from deploy.run_folder import socket_endpoint
from faults.browser import BROWSER, OPTIONS, needs_browser
from faults.processes import small_mission
from faults.scripted_ground import ScriptedGround
from protocol.bus import connect
from protocol.mission_file import mission_to_json
from protocol.obstacle_settings import Obstacles
from protocol.operation_settings import CONSOLE_FILE, Console

PATIENCE_S = 40.0
SMALL, LARGE = ViewportSize(width=900, height=1000), ViewportSize(width=1400, height=900)
"""With the small one little is left for the scene, which takes seconds a frame to draw without a graphics card."""
POLL_S = 0.02
DRAWN_S = 1.2
"""In this time everything is drawn once; whether it was cannot be seen from outside."""
DRONES = (1, 3)

pytestmark = [
    pytest.mark.processes,
    pytest.mark.asyncio(loop_scope="module"),
    needs_browser,
]


@dataclass(frozen=True)
class Open:
    """A console, the ground station behind it, and a browser in front."""

    ground: ScriptedGround
    page: Page
    url: str
    log: Path
    foreign: list[str]
    """Addresses of other computers that the page asked for."""
    complaints: list[str]
    """Errors in the browser's console."""

    async def choose(self, now: str, then: str) -> None:
        """In the dropdown that shows ``now``."""
        await self.page.locator(f'input[role=combobox][value="{now}"]').click()
        await self.page.get_by_role("option", name=then, exact=True).click()

    async def press(self, button: str) -> None:
        await self.page.get_by_role("button", name=button, exact=True).click()

    def shown(self, part: str) -> Locator:
        """What a panel says."""
        return self.page.locator(f"[data-console={part}]")


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(PATIENCE_S):
        while not condition():  # noqa: ASYNC110  # of what is not ours to signal
            await asyncio.sleep(POLL_S)


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def opened(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Open]:
    run = tmp_path_factory.mktemp("run")
    mission = small_mission(run, len(DRONES))
    flight = mission.flight.model_copy(update={"obstacles": Obstacles(enabled=True)})
    mission = mission.model_copy(update={"console": Console(port=0), "flight": flight})
    (run / "mission.json").write_text(mission_to_json(mission))
    private = tmp_path_factory.mktemp("z", numbered=True)
    endpoint = socket_endpoint(private)
    async with AsyncExitStack() as stack:
        bus = await stack.enter_async_context(connect(endpoint, mission.name, router=True))
        ground = ScriptedGround(mission, bus)
        await stack.enter_async_context(ground.flying())
        command = ("--mission", run / "mission.json", "--endpoint", endpoint, "--run", run, "--speed", "1")
        with (run / "console.log").open("wb") as log:
            console = await asyncio.create_subprocess_exec(
                sys.executable, "-P", "-m", "ground_station.console", *command, stderr=log, env=environment(os.environ)
            )
        stack.push_async_callback(console.wait)
        stack.callback(console.send_signal, signal.SIGTERM)
        await until((run / CONSOLE_FILE).exists)
        url = json.loads((run / CONSOLE_FILE).read_text())["url"]
        playwright = await stack.enter_async_context(async_playwright())
        browser = await playwright.chromium.launch(executable_path=BROWSER, args=OPTIONS)
        stack.push_async_callback(browser.close)
        page = await browser.new_page(viewport=SMALL)
        page.set_default_timeout(PATIENCE_S * 1000)
        expect.set_options(timeout=PATIENCE_S * 1000)
        foreign: list[str] = []
        complaints: list[str] = []

        def note(request: Request) -> None:
            if (
                urlsplit(request.url).scheme not in ("data", "blob")
                and urlsplit(request.url).netloc != urlsplit(url).netloc
            ):
                foreign.append(request.url)

        page.on("request", note)

        def complain(message: ConsoleMessage) -> None:
            if message.type == "error":
                complaints.append(f"{message.text} {message.location['url']}")

        page.on("console", complain)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        await page.goto(url)
        await expect(page.locator("[data-console=fleet]")).to_contain_text("flying")
        await page.locator(".mantine-Notification-root button").click()  # says that there is no graphics card
        yield Open(ground, page, url, run / "console.log", foreign, complaints)


async def test_the_page_shows_the_mission_and_asks_nobody_else_for_anything(opened: Open) -> None:
    await expect(opened.shown("activity")).to_have_text("flying by a script")
    await expect(opened.shown("fleet")).to_contain_text("held back by distance to drone 3")
    await expect(opened.shown("picture")).to_be_visible()
    await expect(opened.shown("why")).to_contain_text("of the pull")
    await expect(opened.page.locator("canvas").first).to_be_visible()
    assert "token" not in opened.page.url
    assert opened.foreign == []
    assert opened.complaints == []


@pytest.mark.parametrize("verb", ["pause", "resume"])
async def test_a_button_for_what_can_be_taken_back_commands_all_drones_at_once(opened: Open, verb: str) -> None:
    opened.ground.begin()
    if verb == "resume":
        await opened.press("Pause all")
        await expect(opened.shown("command")).to_have_text("pause all: acknowledged")

    await opened.press(f"{verb.capitalize()} all")

    await expect(opened.shown("command")).to_have_text(f"{verb} all: acknowledged")
    assert (opened.ground.told[-1].verb, opened.ground.told[-1].drones) == (verb, DRONES)
    await expect(opened.shown("fleet")).to_contain_text("holding" if verb == "pause" else "flying")


async def test_a_mission_that_waits_is_started_by_its_button_which_then_goes(opened: Open) -> None:
    opened.ground.begin("waiting")
    button = opened.page.get_by_role("button", name="Start mission", exact=True)

    await button.click()

    await expect(opened.shown("command")).to_have_text("start all: acknowledged")
    assert [command.verb for command in opened.ground.told] == ["start"]
    await expect(button).to_be_hidden()


@pytest.mark.parametrize(
    ("button", "verb"), [("Return all", "return"), ("Land all", "land"), ("Abort mission", "abort")]
)
async def test_what_cannot_be_taken_back_is_commanded_only_after_yes(opened: Open, button: str, verb: str) -> None:
    opened.ground.begin()
    question = opened.page.get_by_text("This cannot be taken back.")

    await opened.press(button)
    await question.wait_for()
    await opened.press("No")
    await expect(question).to_be_hidden()
    assert opened.ground.told == []

    await opened.press(button)
    await question.wait_for()
    assert opened.ground.told == []
    await opened.press(f"Yes, {verb} all drones")

    await expect(opened.shown("command")).to_have_text(f"{verb} all: acknowledged")
    assert [(command.verb, command.drones) for command in opened.ground.told] == [(verb, DRONES)]
    await expect(question).to_be_hidden()


async def test_the_chosen_drone_alone_is_commanded(opened: Open) -> None:
    opened.ground.begin()
    await opened.choose("drone 1", "drone 3")

    await opened.press("Pause this drone")
    await opened.press("Resume this drone")
    await opened.press("Return this drone")
    await opened.press("Yes, return drone 3")
    await opened.press("Land this drone")
    await opened.press("Yes, land drone 3")

    await expect(opened.shown("command")).to_have_text("land drone 3: acknowledged")
    told = [(command.verb, command.drones) for command in opened.ground.told]
    assert told == [(verb, (3,)) for verb in ("pause", "resume", "return", "land")]


async def test_a_command_is_asked_for_until_the_last_drone_acknowledges_it(opened: Open) -> None:
    opened.ground.begin()
    opened.ground.deaf = (3,)

    await opened.press("Pause all")

    await expect(opened.shown("command")).to_have_text("pause all: awaiting drones 3")
    asked = opened.ground.asked
    await until(lambda: opened.ground.asked >= asked + 2)
    opened.ground.deaf = ()
    await expect(opened.shown("command")).to_have_text("pause all: acknowledged")
    assert len(opened.ground.told) == 1


async def test_a_refusal_is_told_with_its_reason(opened: Open) -> None:
    opened.ground.begin()

    await opened.press("Resume all")

    await expect(opened.shown("command")).to_contain_text("refused: nothing to resume")


async def test_a_ground_station_that_falls_silent_is_seen_and_commands_are_not_kept_for_it(
    opened: Open,
) -> None:
    opened.ground.begin()
    opened.ground.silent = True

    await expect(opened.shown("link")).to_contain_text("not heard for")
    await opened.press("Pause all")
    await expect(opened.shown("command")).to_contain_text("did not answer")
    opened.ground.silent = False

    await expect(opened.shown("link")).to_have_count(0)
    assert opened.ground.told == []


async def test_what_comes_over_the_bus_is_text_and_never_markup(opened: Open) -> None:
    opened.ground.say("warning", "<img src=x onerror=alert(1)> & <b>more</b>", "drone/3")
    await opened.page.get_by_role("tab", name="Events").click()

    events = opened.shown("events")
    await expect(events).to_contain_text("<img src=x onerror=alert(1)> & <b>more</b>")
    assert await events.locator("img, b").count() == 0
    await opened.page.get_by_role("tab", name="Fleet").click()


async def test_a_picture_of_the_page_is_kept(opened: Open, tmp_path: Path) -> None:
    picture = Path(os.environ.get("COVRECON_ARTEFACTS", tmp_path)) / "console.png"
    await opened.page.set_viewport_size(LARGE)

    await opened.page.screenshot(path=picture, timeout=PATIENCE_S * 1000)

    await opened.page.set_viewport_size(SMALL)
    assert opened.complaints == []


async def test_the_free_space_is_cut_at_the_chosen_drone_and_at_a_height_of_ones_own(opened: Open) -> None:
    await opened.page.get_by_role("tab", name="View").click()
    height = opened.page.get_by_text("Height, m")
    await expect(height).to_be_hidden()

    await opened.choose("hidden", "at the drone's height")
    await asyncio.sleep(DRAWN_S)
    await opened.choose("at the drone's height", "at a height")
    await expect(height).to_be_visible()
    await asyncio.sleep(DRAWN_S)
    await opened.choose("at a height", "hidden")
    await expect(height).to_be_hidden()
    await opened.page.get_by_role("tab", name="Why there?").click()

    assert opened.complaints == []
    assert "failed" not in opened.log.read_text()


async def test_every_view_of_map_and_importance_is_drawn(opened: Open) -> None:
    await opened.page.get_by_role("tab", name="View").click()

    for now, then in (("colours", "grey"), ("importance", "owners"), ("grey", "hidden"), ("owners", "hidden")):
        await opened.choose(now, then)
        await asyncio.sleep(DRAWN_S)
    await opened.page.get_by_role("tab", name="Why there?").click()

    assert opened.complaints == []
    assert "failed" not in opened.log.read_text()


async def test_another_page_of_the_browser_gets_in_without_the_token_only_where_it_was_given(opened: Open) -> None:
    context = opened.page.context
    assert context.browser is not None
    stranger = await context.browser.new_page()

    answer = await stranger.goto(opened.url.partition("?")[0])

    assert answer is not None
    assert answer.status == 401
    await stranger.close()
